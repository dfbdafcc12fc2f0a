"""The command line: exit codes, one line an error, several runs; the jobs are a stand-in."""

import os
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

import reflectsep
from reflectsep.cli import main
from reflectsep.config import JOBS, DemoJob, FitJob, InfoJob, RelightJob, SimulateJob
from reflectsep.errors import CaptureError

STAND_IN = """
import os
import sys
from pathlib import Path
from types import ModuleType

import reflectsep
from reflectsep.errors import CaptureError


def run(job, progress):
    progress("stage", 1, 1)
    if getattr(job, "seed", 0) == 13:
        raise CaptureError(job.out + ": unlucky")
    if getattr(job, "seed", 0) == 99:
        os._exit(9)
    Path(job.out).mkdir(parents=True)
    return "wrote " + job.out


jobs = ModuleType("reflectsep.jobs")
jobs.run_simulate = jobs.run_fit = run
sys.modules["reflectsep.jobs"] = jobs
"""


@pytest.fixture
def ran(monkeypatch, tmp_path):
    """Jobs that ran, in a folder of their own."""
    done = []

    def run(job, progress):
        progress("stage", 1, 1)
        done.append(job)
        return "done"

    jobs = ModuleType("reflectsep.jobs")
    for name in JOBS:
        setattr(jobs, f"run_{name}", run)
    monkeypatch.setitem(sys.modules, "reflectsep.jobs", jobs)
    monkeypatch.setattr(reflectsep, "jobs", jobs, raising=False)
    monkeypatch.chdir(tmp_path)
    return done


def fails(capsys, words, code):
    """The one line on standard error of a command that fails."""
    assert main(words) == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("reflectsep: error: ")
    return error.removeprefix("reflectsep: error: ").rstrip()


def test_fit_takes_groups_and_paths(ran, capsys):
    words = "capture=in out=there object=wax fit=lin_lee scatter=maximum rig=six overwrite=true"
    assert main(["fit", *words.split()]) == 0
    (job,) = ran
    assert isinstance(job, FitJob)
    assert (job.capture, job.out, job.overwrite) == ("in", "there", True)
    assert (job.fit.scattering, job.scatter.hole_filling, job.object.name) == ("none", "maximum", "wax")
    assert capsys.readouterr().out == "done\n"


def test_lists_reach_the_job_with_their_types(ran):
    assert main(["relight", "result=r", "direction=[0,1,2.5]"]) == 0
    assert main(["fit", "capture=c", "heldout=[L7,8]"]) == 0
    relight, fit = ran
    assert isinstance(relight, RelightJob)
    assert relight.direction == [0.0, 1.0, 2.5]
    assert fit.heldout == ["L7", "8"]


def test_the_demo_is_in_colour_by_a_camera_like_a_real_one(ran):
    assert main(["demo", "object.size_px=64"]) == 0
    (job,) = ran
    assert isinstance(job, DemoJob)
    assert (job.object.preset, job.object.channels, job.object.size_px) == ("turtle", 3, 64)
    assert job.rig.oversample == 2
    assert job.rig.bits == 12
    # Noise clipped at zero would add up over the frames of a sweep.
    assert job.rig.dark_level > 10 * job.rig.read_noise > 0


@pytest.mark.parametrize("path", ["captures/a", "007", "a=b (1), [2]", "it's", "true", "x y\\"])
def test_info_takes_any_path(ran, path):
    assert main(["info", path]) == 0
    assert ran == [InfoJob(path=path)]


def test_a_run_leaves_nothing_of_its_own(ran, tmp_path):
    assert main(["fit", "capture=c"]) == 0
    assert main(["fit", "-m", "object=wax,pudding"]) == 0
    assert list(tmp_path.iterdir()) == []
    assert Path.cwd() == tmp_path


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("fit object=wax fit.n_ss=3", "fit.n_ss: no such setting; did you mean fit.n_s?"),
        ("fit objct=wax", "objct: no such setting; did you mean object?"),
        (
            "fit object=wux",
            "object=wux: no such option; did you mean wax? "
            "(one of generic, marble, plastic, pudding, skin, turtle, wax)",
        ),
        ("fit object=wax fit.n_s=abc", "fit.n_s=abc: expected a number or null"),
        ("fit object=wax fit.max_iterations=1.5", "fit.max_iterations=1.5: expected a whole number"),
        ("fit object=wax overwrite=3", "overwrite=3: expected true or false"),
        ("fit object=wax fit.n_s=-3", "fit.n_s=-3.0: must be above 0"),
        ("fit object=wax scatter.threshold=2", "scatter.threshold=2.0: must be at most 1"),
        ("fit object=wax fit.method=jiont", "fit.method=jiont: expected joint or two_step; did you mean joint?"),
        ("fit object=wax basis=L1", "basis=L1: expected a list of names or null"),
        ("fit object=wax,pudding", "object=wax,pudding: several values mean several runs: add -m"),
        ("fit object=wax object=pudding", "object=pudding: object is given twice"),
        ("fit object", "object: expected KEY=VALUE"),
        ("fit +more=1", "+more=1: settings are set by KEY=VALUE, none can be added or removed"),
        ("fit ~fit", "~fit: expected KEY=VALUE"),
        ("fit out=${no.such}", "out: Interpolation key 'no.such' not found"),
        ("fit", "no capture: give capture=FOLDER, or object=NAME for captures/NAME"),
        ("relight lights=a.lp", "no result: give result=... (result folder to relight)"),
        ("relight result=r direction=[0,0,1", "direction=[0,0,1: cannot be read; quote a value that holds any of"),
        ("info a b", "path='b': path is given twice"),
        ("info", "no path: give path=..."),
        (
            "fti",
            f"fti: no such job; did you mean fit? (one of {', '.join(JOBS)})",
        ),
        ("fit --multrun", "--multrun: no such option; did you mean --multirun?"),
        ("fit -m object=wax,wux", "object=wux: no such option; did you mean wax?"),
        ("fit -m object=wax,pudding fit.n_s=3,-3", "fit.n_s=-3.0: must be above 0"),
        ("fit -m object=wax fit.n_s=3,a", "fit.n_s=a: expected a number or null"),
        ("fit -m object=wax,pudding hydra/launcher=jobs", "In 'hydra/config': Could not find 'hydra/launcher/jobs'"),
        ("fit -m object=wax fit=joint,lin_lee", "object=wax fit=joint and object=wax fit=lin_lee: both would write "),
    ],
)
def test_wrong_settings_are_one_line_and_nothing_runs(ran, capsys, words, line):
    assert fails(capsys, words.split(), 2).startswith(line)
    assert ran == []


def test_no_job_shows_the_help_and_fails(capsys):
    assert main([]) == 2
    assert "usage: reflectsep JOB" in capsys.readouterr().err


def test_multirun_runs_every_combination(ran):
    assert main(["simulate", "--multirun", "object=wax,pudding", "rig=six,twelve"]) == 0
    assert all(isinstance(job, SimulateJob) for job in ran)
    assert [job.out for job in ran] == [
        "captures/wax",
        "captures/wax-twelve",
        "captures/pudding",
        "captures/pudding-twelve",
    ]


def test_multirun_tells_runs_apart_by_interpolation(ran):
    assert main(["fit", "-m", "object=wax", "fit=joint,lin_lee", "out=results/${fit.scattering}"]) == 0
    assert [job.out for job in ran] == ["results/measured", "results/none"]


def test_cfg_prints_the_settings_and_runs_nothing(ran, capsys):
    assert main(["fit", "object=pudding", "--cfg"]) == 0
    printed = capsys.readouterr().out
    assert "capture: captures/pudding\n" in printed
    assert "  hole_filling: profile\n" in printed
    assert ran == []


@pytest.mark.parametrize("error", [CaptureError("a/b.exr: 3x4,\n but 5x6 expected"), OSError(28, "No space left")])
def test_foreseen_errors_of_a_job_are_one_line(ran, capsys, monkeypatch, error):
    def run(_job, _progress):
        raise error

    monkeypatch.setattr(reflectsep.jobs, "run_fit", run)
    assert fails(capsys, ["fit", "capture=c"], 1) == " ".join(str(error).split())


def test_a_bug_keeps_its_traceback(ran, monkeypatch):
    def run(_job, _progress):
        raise ZeroDivisionError

    monkeypatch.setattr(reflectsep.jobs, "run_fit", run)
    with pytest.raises(ZeroDivisionError):
        main(["fit", "capture=c"])
    with pytest.raises(ZeroDivisionError):
        main(["fit", "-m", "object=wax"])


@pytest.mark.parametrize("words", [["fit", "capture=c"], ["fit", "-m", "object=wax,pudding"]])
def test_interruption_is_one_line(ran, capsys, monkeypatch, words):
    def run(_job, _progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(reflectsep.jobs, "run_fit", run)
    assert main(words) == 130
    assert capsys.readouterr().err.split("\n") == ["", "reflectsep: interrupted", ""]


def test_a_run_that_fails_stops_no_other(ran, capsys, monkeypatch):
    def run(job, _progress):
        if job.object.name == "wax":
            raise CaptureError("captures/wax: melted")
        ran.append(job)

    monkeypatch.setattr(reflectsep.jobs, "run_fit", run)
    assert fails(capsys, ["fit", "-m", "object=wax,pudding"], 1) == "object=wax: captures/wax: melted"
    assert [job.object.name for job in ran] == ["pudding"]


@pytest.fixture
def command(tmp_path):
    """Runs the command in a process of its own (as do its worker processes) with the stand-in for the jobs."""
    hook = tmp_path / "hook"
    hook.mkdir()
    (hook / "sitecustomize.py").write_text(STAND_IN)
    package = str(Path(reflectsep.__file__).parent.parent)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(hook), package]), "OMP_NUM_THREADS": "1"}
    work = tmp_path / "work"
    work.mkdir()

    def run(*words):
        arguments = [sys.executable, "-m", "reflectsep", *words]
        return subprocess.run(arguments, cwd=work, env=environment, capture_output=True, text=True, check=False)

    run.work = work
    return run


@pytest.mark.parametrize("launcher", ["basic", "joblib", pytest.param("submitit_local", marks=pytest.mark.slow)])
def test_launchers_leave_only_what_the_jobs_wrote(command, launcher):
    if launcher != "basic":
        pytest.importorskip(f"hydra_plugins.hydra_{launcher.split('_')[0]}_launcher")
    done = command("simulate", "-m", "object=wax,pudding", f"hydra/launcher={launcher}")
    assert (done.returncode, sorted(done.stdout.splitlines())) == (0, ["wrote captures/pudding", "wrote captures/wax"])
    found = sorted(str(path.relative_to(command.work)) for path in command.work.rglob("*"))
    assert found == ["captures", "captures/pudding", "captures/wax"]


def test_joblib_reports_a_failure_in_one_line(command):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    done = command("simulate", "-m", "seed=1,13", "out=a${seed}", "hydra/launcher=joblib")
    errors = [line for line in done.stderr.splitlines() if "error" in line.lower()]
    assert (done.returncode, errors) == (1, ["reflectsep: error: seed=13: a13: unlucky"])
    assert "Traceback" not in done.stderr
    assert [path.name for path in command.work.iterdir()] == ["a1"]


@pytest.mark.slow
def test_submitit_reports_a_failure_in_one_line(command):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    done = command("simulate", "-m", "seed=1,13", "out=a${seed}", "hydra/launcher=submitit_local")
    assert (done.returncode, done.stderr.splitlines()) == (1, ["reflectsep: error: seed=13: a13: unlucky"])
    assert [path.name for path in command.work.iterdir()] == ["a1"]


@pytest.mark.slow
def test_a_job_that_a_cluster_ends_is_one_line_and_leaves_its_output(command):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    done = command("simulate", "-m", "seed=1,99", "out=a${seed}", "hydra/launcher=submitit_local")
    assert done.returncode == 1
    (kept,) = command.work.glob(".reflectsep-jobs-*")
    assert done.stderr.splitlines()[-1].startswith(f"reflectsep: error: {kept}: a job ended without an answer: ")
    assert done.stdout.splitlines() == ["wrote a1"]


def test_a_cluster_that_is_not_there_is_told_before_anything_is_sent(ran, capsys, monkeypatch, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ["fit", "-m", "object=wax,pudding", "hydra/launcher=submitit_slurm", "hydra.launcher.partition=day"]
    assert fails(capsys, words, 2).startswith("hydra/launcher=submitit_slurm: no srun here")
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize("launcher", ["joblib", "submitit_slurm"])
def test_a_launcher_that_is_not_installed_names_its_extra(ran, capsys, monkeypatch, launcher):
    extra = launcher.split("_")[0]
    monkeypatch.setitem(sys.modules, f"hydra_plugins.hydra_{extra}_launcher", None)
    words = ["fit", "-m", "object=wax,pudding", f"hydra/launcher={launcher}"]
    said = f"hydra/launcher={launcher}: not installed; pip install 'reflectsep[{extra}]'"
    assert fails(capsys, words, 1) == said
    assert ran == []


@pytest.mark.parametrize("words", [["--help"], ["fit", "--help"], ["--version"]])
def test_help_comes_at_once_and_imports_nothing_heavy(words):
    program = (
        "import sys; from reflectsep.cli import main; code = main(sys.argv[1:]);"
        "heavy = {'torch', 'hydra', 'omegaconf', 'numpy', 'rich', 'yaml'} & set(sys.modules);"
        "sys.exit(f'imported {heavy}' if heavy else code)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(reflectsep.__file__).parent.parent)}
    started_s = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", program, *words], env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert time.monotonic() - started_s < 1.0


def test_a_reader_that_has_seen_enough_is_no_error():
    environment = os.environ | {"PYTHONPATH": str(Path(reflectsep.__file__).parent.parent)}
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "reflectsep", "--help"]
    done = subprocess.run(command, env=environment, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")


def test_help_lists_every_job_and_every_option(capsys):
    assert main(["--help"]) == 0
    overview = capsys.readouterr().out
    assert all(f"\n  {job} " in overview for job in JOBS)
    assert main(["fit", "--help"]) == 0
    text = capsys.readouterr().out
    for word in ("capture=", "fit=lin_lee", "fit.n_s=null", "scatter=maximum", "scatter.threshold=0.25", "rig=six"):
        assert word in text
