"""The pixels that everyone solves: those of a simulated capture, under the globals that its fit ends with."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.calibrate.stack import calibrate_stack
from reflectsep.config import FitSettings, ObjectSettings, RigSettings, ScatterSettings, SimulateJob
from reflectsep.data import PhotometricStack
from reflectsep.export.harmonics import ptm_terms
from reflectsep.fit.neighbours import neighbours
from reflectsep.fit.options import FitOptions
from reflectsep.fit.problem import PixelProblem
from reflectsep.fit.reflectance import all_messages, fit_globals, observe, prepare, solved, start_of
from reflectsep.io.capture import load_capture
from reflectsep.jobs import run_simulate
from reflectsep.pipeline import measure
from reflectsep.progress import silent
from reflectsep.solve.levenberg import Solution, Termination

OPTIONS = FitOptions()
END = Termination(tolerance=OPTIONS.tolerance, max_iterations=OPTIONS.max_iterations)


@dataclass(frozen=True)
class Case:
    """Pixels, the globals, and where the iterations begin."""

    problem: PixelProblem
    shared: Float[Tensor, "G"]
    start: Float[Tensor, "P pixels"]
    stack: PhotometricStack


def make_case(size_px: int, channels: Literal[1, 3]) -> Case:
    """A wax under six lights with three sweeps: every pixel's first solve, from the robust body."""
    with tempfile.TemporaryDirectory() as folder:
        item = ObjectSettings(name="wax", size_px=size_px, channels=channels)
        rig = RigSettings(bits=12, read_noise=0.0005, shot_noise=0.002)
        run_simulate(SimulateJob(object=item, rig=rig, out=str(Path(folder) / "wax")))
        capture = load_capture(Path(folder) / "wax")
        stack, _ = calibrate_stack(capture)
        scattering = measure(capture, stack, FitSettings(), ScatterSettings(), silent)
    obs, mask, _ = observe(stack, scattering, OPTIONS)
    state = fit_globals(prepare(obs, mask, OPTIONS), OPTIONS, silent)
    problem = state.problem.take(slice(None))
    case = Case(problem, state.shared, start_of(problem, state.shared), stack)
    if state.smooth is None:
        return case
    found = solve(case).local
    said = all_messages(problem, found, state.shared, OPTIONS.chunk)
    return replace(case, problem=replace(problem, neighbours=neighbours(said, mask, state.smooth)))


def solve(case: Case) -> Solution:
    """As the fit does, in its chunks."""
    return solved(case.problem, case.start, case.shared, END, OPTIONS)


def cost_of(case: Case, local: Float[Tensor, "P pixels"]) -> Float[Tensor, "pixels"]:
    """Costs of pixels by the fit's own residuals."""
    return case.problem.robust(case.problem.residuals(local, case.shared))[0]


def polynomials(case: Case) -> Float[Tensor, "6 channels pixels"]:
    """A polynomial texture map of the same pictures: least squares of six terms of the light's direction."""
    assert case.stack.light_vectors is not None
    directions = torch.nn.functional.normalize(case.stack.light_vectors.double(), dim=-1)
    return torch.tensordot(torch.linalg.pinv(ptm_terms(directions)), case.problem.obs.images, 1)
