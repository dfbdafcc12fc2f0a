"""Chunks worked on elsewhere: on a device that is pretended here, and on a real one where there is one."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

from reflectsep.config import FitSettings
from reflectsep.errors import SettingsError
from reflectsep.fit import reflectance
from reflectsep.fit.options import FitOptions
from reflectsep.fit.reflectance import fit_reflectance
from reflectsep.pipeline import fit_options

QUICK = FitOptions(max_iterations=1, chunk=60, tolerance=1e-2)
CPU, CUDA = torch.device("cpu"), torch.device("cuda")


class Pretended(TorchFunctionMode):
    """The processor's memory in two parts, the second called `cuda`: what is in one may not meet what is in the other.

    Tensors say that they are where they were made or moved to. Numbers (0-d tensors of the processor) may go anywhere,
    and whole rows may be copied into, as on a real device.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if func == Tensor.device.__get__:  # pyright: ignore[reportAttributeAccessIssue]
            return CUDA if is_there(args[0]) else CPU
        place = torch.device(kwargs.pop("device")) if kwargs.get("device") is not None else None
        kwargs.pop("device", None)
        if func is Tensor.to and isinstance(args[1], torch.device | str):
            place, args = torch.device(args[1]), (args[0], *args[2:])
        if func is Tensor.cpu:
            place = CPU
        tensors = [t for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)]
        there = [is_there(t) for t in tensors]
        copied_into = func is Tensor.__setitem__ and not there[0] and len(tensors) == 2
        if place is None and any(there) and not copied_into:
            self.calls += 1
            stray = [tuple(t.shape) for t, far in zip(tensors, there, strict=True) if not far and t.ndim]
            assert not stray, f"{func}: tensors of {stray} are not on the device"
        result = args[0].clone() if func is Tensor.to and len(args) == 1 else func(*args, **kwargs)
        if func is Tensor.__setitem__:
            return result
        for each in result if isinstance(result, tuple | list) else (result,):
            if isinstance(each, Tensor):
                each.there = any(there) if place is None else place.type == "cuda"
        return result


def is_there(tensor: Tensor) -> bool:
    return getattr(tensor, "there", False)


def test_the_pretended_device_tells_what_is_not_on_it():
    with Pretended():
        far = torch.ones(3).to(CUDA)
        assert (far + 1.0)[1:].device == CUDA
        assert torch.arange(3, device=far.device).device == CUDA
        with pytest.raises(AssertionError, match="not on the device"):
            far + torch.arange(3)
        near = torch.zeros(5)
        near[1:4] = far
        assert near.device == CPU
        assert far.to("cpu").device == CPU


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="the fit does not read its device yet")
@pytest.mark.parametrize("options", [{}, {"alpha_sd": 0.02, "lobe": "power", "refine_n_d": True}])
def test_chunks_are_worked_on_wholly_on_the_device(paper_case, monkeypatch, options):
    # One start and one round: what is tested is where, not how well.
    monkeypatch.setattr(reflectance, "START_N_S", (20.0, 20.0))
    monkeypatch.setattr(reflectance, "ROUNDS", 1)
    case = paper_case(size=9, channels=3, n_d=1.2)
    quick = replace(QUICK, **options)
    expected = fit_reflectance(case.stack, case.scattering, quick)
    with Pretended() as pretended:
        fit = fit_reflectance(case.stack, case.scattering, replace(quick, device="cuda"))
    assert pretended.calls > 5000
    for name in ("a", "n_s", "d", "s", "B", "d_sd", "residual", "flags"):
        assert getattr(fit, name).device == CPU, name
        assert torch.equal(getattr(fit, name), getattr(expected, name)), name


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_said():
    with pytest.raises(
        SettingsError, match=r"fit\.device=cuda: no CUDA device is to be had \(torch .+\); expected cpu"
    ):
        fit_options(FitSettings(device="cuda"))
    assert fit_options(FitSettings()).device == "cpu"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_a_fit_on_a_real_device_is_that_of_the_processor(paper_case):
    case = paper_case(size=24, channels=3, sigma=0.002)
    expected = fit_reflectance(case.stack, case.scattering, FitOptions())
    fit = fit_reflectance(case.stack, case.scattering, FitOptions(device="cuda"))
    torch.testing.assert_close(fit.a, expected.a, rtol=1e-3, atol=0.0)
    torch.testing.assert_close(fit.n_s, expected.n_s, rtol=1e-3, atol=0.0)
    assert fit.cost == pytest.approx(expected.cost, rel=1e-4)
