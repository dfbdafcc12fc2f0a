"""Help texts, made from the settings and the first lines of the YAML files; imports nothing heavy."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import reflectsep
from reflectsep.config import JOBS
from reflectsep.errors import SettingsError
from reflectsep.settings import kinds, shown

EXAMPLES = {
    "simulate": ("object=wax", "object=pudding rig=twelve out=captures/p12", "-m object=wax,pudding"),
    "capture": (
        "object=wax rig=simulated out=captures/wax",
        "object=wax rig=bench dry_run=true",
        "object=wax rig=bench rig.devices.stage.port=/dev/ttyACM0 resume=true",
    ),
    "capture_and_fit": ("object=wax rig=simulated",),
    "fit": (
        "capture=captures/wax out=results/wax",
        "object=wax fit=lin_lee scatter=maximum",
        "-m object=wax,pudding hydra/launcher=joblib",
    ),
    "relight": (
        "result=results/wax lights=lights.lp out=relit",
        "result=results/wax 'direction=[0.3,0.2,0.9]'",
        "result=results/wax orbit=72 format=mp4 out=orbit",
    ),
    "compare": ("result=results/wax out=compare.png",),
    "report": ("result=results/wax", "result=results/wax baseline=false out=wax.html"),
    "view": ("result=results/wax", "result=results/wax other=results/wax_lin_lee out=both.html"),
    "export": ("result=results/wax", "result=results/wax format=textures out=wax_textures"),
    "info": ("captures/wax", "results/wax"),
    "check": ("capture=captures/wax", "capture=captures/wax sheet=check.png", "capture=captures/wax --json"),
    "calibrate": ("capture=captures/cat chrome=captures/chrome", "capture=captures/cat response=debevec"),
    "demo": ("", "out=elsewhere"),
}


def config_dir() -> Path:
    """Folder of the YAML files: inside the installed package, or beside it in a source tree.

    Raises:
        SettingsError: the installation is broken.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / "fit_job.yaml").is_file():
            return folder
    raise SettingsError(f"{package / 'configs'}: the configs of this installation are missing; install it again")


def groups(cls: type) -> list[str]:
    """Names of the config groups of a job."""
    return [name for name, kind in kinds(cls).items() if dataclasses.is_dataclass(kind.base)]


def group_options(group: str) -> dict[str, str]:
    """Options of a config group, each with the first comment line of its file."""
    options = {}
    for file in sorted((config_dir() / group).glob("*.yaml")):
        with file.open(encoding="utf-8") as lines:
            options[file.stem] = lines.readline().lstrip("# ").strip()
    return options


def overview() -> str:
    """Help of the command as a whole."""
    width = max(map(len, JOBS))
    jobs = "\n".join(f"  {name:{width}}  {_summary(cls)}" for name, cls in JOBS.items())
    return f"""reflectsep {reflectsep.__version__}: separate reflectance from photometric images, and relight it

usage: reflectsep JOB [KEY=VALUE ...] [-m]

jobs:
{jobs}

options:
  -h, --help      this text; after a job, its settings
  -m, --multirun  KEY=A,B runs once for A and once for B; hydra/launcher=joblib (submitit_slurm): side by side
  --json          of `check`: print JSON for scripts
  --cfg           print the settings of a job, do not run it
  --version

`reflectsep demo` shows the whole thing without any data. `reflectsep fit --help` lists the settings of a fit."""


def job_help(job: str) -> str:
    """Help of one job: its keys, its groups with their options, and the keys of each group."""
    cls = JOBS[job]
    argument = "PATH" if job == "info" else "[KEY=VALUE ...] [-m]"
    parts = [f"reflectsep {job}: {_summary(cls)}", f"usage: reflectsep {job} {argument}", "settings:\n" + _table(cls)]
    for group in groups(cls):
        options = group_options(group)
        base = kinds(cls)[group].base
        inner = [kind.base for kind in kinds(base).values() if dataclasses.is_dataclass(kind.base)]
        tables = "\n".join(_table(one) for one in (base, *inner))
        width = max(map(len, options))
        listed = "\n".join(f"  {group}={name:{width}}  {text}" for name, text in options.items())
        parts.append(f"{group}, one of:\n{listed}\n" + tables)
    examples = "\n".join(f"  reflectsep {job} {words}".rstrip() for words in EXAMPLES[job])
    return "\n\n".join([*parts, f"examples:\n{examples}"])


def _summary(cls: type) -> str:
    return (cls.__doc__ or "").splitlines()[0]


def _table(cls: type) -> str:
    rows = []
    of = kinds(cls)
    for f in dataclasses.fields(cls):
        if "text" not in f.metadata:
            continue
        given = "" if f.default is dataclasses.MISSING or f.default == "" else shown(f.default)
        expected = "" if of[f.name].base is str and not of[f.name].choices else f" ({of[f.name].expected})"
        key = f"{getattr(cls, 'key', '')}{f.name}={given}"
        rows.append((key, f.metadata["text"] + expected))
    width = max(len(key) for key, _ in rows)
    return "\n".join(f"  {key:{width}}  {text}" for key, text in rows)
