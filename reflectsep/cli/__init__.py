"""The command `reflectsep <job> [overrides]`: the only place, with the scripts, that knows of Hydra."""

from reflectsep.cli.command import main

__all__ = ["main"]
