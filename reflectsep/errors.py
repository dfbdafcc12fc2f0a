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


class WorkerError(ReflectsepError):
    """Another process of a shared run is gone, or does not answer."""


class SaidElsewhereError(ReflectsepError):
    """What stopped this process of a shared run has been said by another one."""


class MissingExtraError(ReflectsepError):
    """An optional dependency is needed and not installed."""


class RigError(ReflectsepError):
    """The rig cannot do what was asked, or stopped doing it; the text says what state it is in."""


class StageError(RigError):
    """The stage: no connection, a refused or failed motion, a sweep that was not what was asked for."""


class AlarmError(StageError):
    """The stage's controller locked itself; nothing moves until it has been reset and homed."""


class LinkLostError(StageError):
    """The line to a device broke; the device may still be moving."""


class CameraError(RigError):
    """The camera: absent, died, refused a setting, or gave too few whole frames."""


class LightsError(RigError):
    """The lights could not be switched, or say that they are not what was asked for."""


class SessionError(RigError):
    """The session folder cannot be used, or was made by another plan or rig."""
