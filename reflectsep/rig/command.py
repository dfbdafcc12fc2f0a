"""Running a program of the user's: an argument list, never a shell string, with a deadline."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence

from reflectsep.errors import RigError, SettingsError


def checked_arguments(given: object, where: str) -> tuple[str, ...]:
    """An argument list from settings.

    Raises:
        SettingsError: a string, which a shell would have to take apart, or an empty list.
    """
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise SettingsError(f"{where}={given!r}: expected a list of arguments, as in [program, argument]")
    return tuple(str(word) for word in given)


def run_command(arguments: Sequence[str], values: Mapping[str, str], timeout_s: float, error: type[RigError]) -> str:
    """Run a program and return what it printed.

    Args:
        arguments: The program and its arguments; `{name}` in them stands for a value.
        values: By name. They are put into arguments, never taken apart.
        timeout_s: After which it is killed.
        error: Class of the errors raised.

    Raises:
        RigError: (as `error`) not there, failed, or too slow.
    """
    words = [_filled(word, values) for word in arguments]
    try:
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        raise error(f"{words[0]}: not done after {timeout_s:g} s; it was killed") from None
    except OSError as reason:
        raise error(f"{words[0]}: cannot be run: {reason.strerror or reason}") from reason
    if done.returncode != 0:
        said = " ".join((done.stderr or done.stdout).split())[-200:]
        raise error(f"{words[0]}: failed with exit code {done.returncode}{f': {said}' if said else ''}")
    return done.stdout.strip()


def _filled(word: str, values: Mapping[str, str]) -> str:
    for name, value in values.items():
        word = word.replace("{" + name + "}", value)
    return word
