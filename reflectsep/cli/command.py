"""Entry point: find the job, build its settings, run it, and turn every foreseen error into one line.

Exit codes: 0 done, 1 the data or the fit failed or a check found something bad, 2 the settings or the usage are wrong,
130 interrupted.
Hydra and the jobs are imported where they are used, so that `--help` answers at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import reflectsep
from reflectsep.cli.help import job_help, overview
from reflectsep.config import JOBS
from reflectsep.errors import ReflectsepError, SaidElsewhereError, SettingsError
from reflectsep.settings import nearest

FAILED = 1
USAGE = 2
INTERRUPTED = 130

_OPTIONS = {
    "-h": "help",
    "--help": "help",
    "-m": "multirun",
    "--multirun": "multirun",
    "--cfg": "cfg",
    "--json": "json",
    "--progress": "progress",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: Words after `reflectsep`; those of the process unless given.

    Returns:
        Exit code.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = _dispatch(words)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print("\nreflectsep: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of a pipe, such as `head`, has seen enough; what Python still holds for it goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (ReflectsepError, OSError) as error:
        return complain(error)


def complain(error: Exception, where: str = "") -> int:
    """Write the one line of an error to standard error.

    Args:
        error: What went wrong.
        where: Which run of several.

    Returns:
        Exit code.
    """
    if isinstance(error, SaidElsewhereError):
        return FAILED
    if isinstance(error, SettingsError) and os.environ.get("RANK", "0") != "0":
        return USAGE  # the processes of a shared run have the same settings; the first says it
    said = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else str(error)
    text = " ".join(said.split())
    print(f"reflectsep: error: {where}{text}", file=sys.stderr, flush=True)
    return USAGE if isinstance(error, SettingsError) else FAILED


def _dispatch(words: list[str]) -> int:
    if not words:
        print(overview(), file=sys.stderr)
        return USAGE
    job, *rest = words
    if job in ("-h", "--help", "help"):
        print(overview())
        return 0
    if job == "--version":
        print(f"reflectsep {reflectsep.__version__}")
        return 0
    if job not in JOBS:
        raise SettingsError(f"{job}: no such job{nearest(job, JOBS)} (one of {', '.join(JOBS)})")
    options, overrides = _split(rest)
    if "help" in options:
        print(job_help(job))
        return 0
    if "json" in options:
        if job != "check":
            raise SettingsError(f"--json: {job} has none, only check has")
        overrides = [*overrides, "json=true"]
    from reflectsep.cli import runs

    if "cfg" in options:
        return runs.show(job, overrides)
    run = runs.several if "multirun" in options else runs.single
    return run(job, overrides, lines="progress" in options)


def _split(words: list[str]) -> tuple[set[str], list[str]]:
    """Options (by their long names) and overrides; everything after `--` is an override."""
    options: set[str] = set()
    for index, word in enumerate(words):
        if word == "--":
            return options, [w for w in words[:index] if w not in _OPTIONS] + words[index + 1 :]
        if word in _OPTIONS:
            options.add(_OPTIONS[word])
        elif word.startswith("-"):
            known = [*_OPTIONS, "--version"]
            raise SettingsError(f"{word}: no such option{nearest(word, known)} (one of {', '.join(_OPTIONS)})")
    return options, [word for word in words if word not in _OPTIONS]
