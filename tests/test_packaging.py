"""What is installed: one version, light imports, the public names, the configs, the scripts."""

import os
import subprocess
import sys
import tomllib
import zipfile
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import reflectsep
from reflectsep.config import JOBS

ROOT = Path(__file__).resolve().parent.parent


def python(program, cwd=None):
    environment = os.environ | {"PYTHONPATH": str(Path(reflectsep.__file__).parent.parent)}
    command = [sys.executable, *program]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


def test_version_has_one_source():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["hatch"]["version"]["path"] == "reflectsep/__init__.py"
    assert python(["-m", "reflectsep", "--version"]).stdout == f"reflectsep {reflectsep.__version__}\n"


def test_importing_the_package_imports_nothing_heavy():
    heavy = "{'torch', 'numpy', 'hydra', 'OpenEXR', 'matplotlib', 'kornia', 'rich'}"
    done = python(["-c", f"import sys, reflectsep; print({heavy} & set(sys.modules))"])
    assert done.stdout == "set()\n"


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonesuch'"):
        _ = reflectsep.nonesuch  # type: ignore[attr-defined]
    assert {"fit", "load", "load_capture", "Separation", "__version__"} <= set(dir(reflectsep))


@pytest.mark.parametrize("before", ["", "import reflectsep.fit; "])
def test_fit_is_a_function_and_a_package_whichever_is_imported_first(before):
    program = f"""
import sys, types
{before}
import reflectsep
pipeline = types.ModuleType("reflectsep.pipeline")
pipeline.fit = lambda capture, **more: (capture, more)
sys.modules["reflectsep.pipeline"] = pipeline
assert reflectsep.fit("capture", basis=3) == ("capture", {{"basis": 3}})
import reflectsep.fit as package
assert package.__path__ and package is reflectsep.fit
"""
    done = python(["-c", program])
    assert (done.returncode, done.stderr) == (0, "")


def test_public_names_are_lazy_and_real(monkeypatch):
    pipeline = ModuleType("reflectsep.pipeline")
    pipeline.load, pipeline.load_capture = object(), object()  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "reflectsep.pipeline", pipeline)
    assert reflectsep.load is pipeline.load  # type: ignore[attr-defined]
    assert reflectsep.load_capture is pipeline.load_capture  # type: ignore[attr-defined]


@pytest.mark.slow
def test_public_names_lead_to_what_they_name():
    pipeline = import_module("reflectsep.pipeline")
    assert reflectsep.load is pipeline.load
    assert reflectsep.load_capture is pipeline.load_capture
    assert reflectsep.Separation is import_module("reflectsep.separation").Separation
    assert all(callable(getattr(import_module("reflectsep.jobs"), f"run_{job}")) for job in JOBS)


@pytest.mark.parametrize("job", JOBS)
def test_scripts_are_the_jobs(job):
    done = python([str(ROOT / "scripts" / f"{job}.py"), "--help"])
    assert (done.returncode, done.stdout.split(":")[0]) == (0, f"reflectsep {job}")


def test_there_is_one_script_a_job():
    measuring = (
        *(
            "benchmark",
            "fit_memory",
            "hole_fillings",
            "seams",
            "shared_speed",
            "sweep_speed",
            "scattering_spectrum",
        ),
        "time_left",
    )
    several = ("tiles",)  # many fits
    assert sorted(path.stem for path in (ROOT / "scripts").glob("*.py")) == sorted([*JOBS, *measuring, *several])
    assert sorted(path.stem for path in (ROOT / "configs").glob("*.yaml")) == sorted(f"{job}_job" for job in JOBS)


@pytest.mark.slow
def test_wheel_holds_the_configs(tmp_path):
    build = pytest.importorskip("hatchling.builders.wheel", reason="only in the extra `dev`")

    (wheel,) = build.WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    names = set(zipfile.ZipFile(wheel).namelist())
    for path in (ROOT / "configs").rglob("*.yaml"):
        assert f"reflectsep/configs/{path.relative_to(ROOT / 'configs').as_posix()}" in names
    assert f"reflectsep-{reflectsep.__version__}-" in str(wheel)
