"""Errors that a person can act on: what failed, what was found, what was expected, and in which file."""


class ReflectsepError(Exception):
    """Base of every error that this package raises on purpose; its text is one line, fit for a terminal."""


class CaptureError(ReflectsepError):
    """A capture folder, or a file in it, is not what its manifest or the format says."""


class ResultError(ReflectsepError):
    """A result folder, or a file in it, is missing, damaged or in the way."""


class SettingsError(ReflectsepError):
    """A setting is misspelt, of the wrong type, or impossible."""


class LightError(ReflectsepError):
    """Light directions that cannot carry the method: coplanar, repeated, too few, or missing."""


class SweepError(ReflectsepError):
    """A sweep from which the scattering cannot be measured."""


class FitError(ReflectsepError):
    """A fit that has nothing to stand on: no pixels, too few pictures, no finite cost."""


class MissingExtraError(ReflectsepError):
    """An optional dependency is needed and not installed."""
