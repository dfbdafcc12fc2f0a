"""Running a job once, or several times through Hydra's launchers."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from reflectsep.cli.cluster import scratch
from reflectsep.cli.command import complain
from reflectsep.cli.overrides import build, checked, expanded, flat, hydra_ready, launcher_of, settings_of, swept
from reflectsep.config import Job
from reflectsep.errors import ReflectsepError, SettingsError
from reflectsep.progress import shown, silent

_QUIET = (
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
    "hydra.output_subdir=null",
    "hydra.job.chdir=false",
    "hydra.sweep.subdir=.",
)
"""Hydra writes no logs and no copies of the config, and stays in the working folder."""


def single(job: str, words: Sequence[str], *, lines: bool = False) -> int:
    """Run `job` once; with `lines` its progress is a line a stage, on a terminal or not.

    Raises:
        ReflectsepError: whatever stopped it.
    """
    with hydra_ready():
        settings = settings_of(job, checked(job, words, sweeping=False))
    return _run(job, settings, lines=lines)


def show(job: str, words: Sequence[str]) -> int:
    """Print the settings that a run would have, as YAML."""
    with hydra_ready():
        settings = settings_of(job, checked(job, words, sweeping=False))
    print(OmegaConf.to_yaml(OmegaConf.create(dataclasses.asdict(settings))), end="")
    return 0


def several(job: str, words: Sequence[str], *, lines: bool = False) -> int:
    """Run `job` once for every combination of the values given; a run that fails stops no other.

    All settings are checked before the first run starts.

    Raises:
        SettingsError: any of the runs is impossible, or two would write to one place.
        WorkerError: a job on a cluster ended without an answer.
    """
    with hydra_ready():
        overrides = checked(job, words, sweeping=True)
        own = [word for word in overrides if not word.startswith(("hydra.", "hydra/"))]
        _check_places([(run, settings_of(job, run)) for run in expanded(own)])
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None  # hydra_ready made it
        with scratch(launcher_of(overrides)) as folder:
            quiet = [*_QUIET, f"hydra.sweep.dir='{folder}'"]
            try:
                batches = hydra.multirun(f"{job}_job", partial(_task, job, swept(own), lines), [*overrides, *quiet])
            except (HydraException, OmegaConfBaseException) as error:
                raise SettingsError(flat(error)) from None
    return max((code for code in _codes(batches)), default=0)


def _check_places(runs: Iterable[tuple[list[str], Job]]) -> None:
    taken: dict[str, list[str]] = {}
    for overrides, settings in runs:
        place = getattr(settings, "out", None)
        if place is None:
            continue
        place = os.path.abspath(place)
        if place in taken:
            both = f"{' '.join(taken[place])} and {' '.join(overrides)}"
            raise SettingsError(
                f"{both}: both would write {place}; tell them apart, as in 'out=results/${{fit.method}}'"
            )
        taken[place] = overrides


def _task(job: str, keys: frozenset[str], lines: bool, config: DictConfig) -> int:
    """One run of several, perhaps in a process of its own: an exit code is all that travels back."""
    hydra = HydraConfig.get()
    varied = [override for override in hydra.overrides.task if override.split("=")[0] in keys]
    where = f"{' '.join(varied)}: " if varied else ""
    try:
        parallel = "BasicLauncher" not in hydra.launcher["_target_"]
        return _run(job, build(job, config), where, parallel=parallel, lines=lines)
    except (ReflectsepError, OSError) as error:
        return complain(error, where)


def _run(job: str, settings: Job, where: str = "", *, parallel: bool = False, lines: bool = False) -> int:
    from reflectsep import jobs

    with _crew(job) as first:
        run = getattr(jobs, f"run_{job}")
        if not first:  # another process of this run shows what is done, and writes it
            run(settings, silent)
            return 0
        with shown(where, parallel=parallel, lines=lines) as progress:
            text = run(settings, progress)
        if text:
            print(text, flush=True)
        return getattr(text, "exit_code", 0)  # what a check says of the capture


@contextmanager
def _crew(job: str) -> Iterator[bool]:
    """The processes that share a fit, where `torchrun` has started several; gives whether this is the first."""
    count = os.environ.get("WORLD_SIZE", "1")
    if count == "1":
        yield True
        return
    if job != "fit":
        raise SettingsError(f"{job}: only fit shares its work among processes ({count} were started)")
    from reflectsep.solve.sharing import shared_work

    with shared_work() as crew:
        yield crew.first


def _codes(batches: Any) -> Iterable[int]:
    """Exit code of every run; a run that broke in an unforeseen way raises here, with its own traceback."""
    for batch in batches:
        for run in batch:
            if isinstance(run, JobReturn):
                yield run.return_value
