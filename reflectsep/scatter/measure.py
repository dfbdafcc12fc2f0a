"""Scattering of every light from the slab sweeps (paper, section 6).

Two passes over the frames of each sweep: when does the slab pass each pixel (passage.py), from which n_d and C follow
(Eq. 25; gains.py, exponent.py); then the lit band is left out (band.py), the holes are filled (filling.py, kernel.py)
and the n_d-root sum is divided by C (Eq. 24).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool
from torch import Tensor

from reflectsep.data import FrameStream, PhotometricStack, Scattering, SweepReport
from reflectsep.errors import SweepError
from reflectsep.flags import Flag, mark
from reflectsep.io.ahead import one_thread
from reflectsep.progress import Progress, silent
from reflectsep.room import copied, empty
from reflectsep.scatter.band import LitBand
from reflectsep.scatter.evidence import Evidence, Picture
from reflectsep.scatter.exponent import complete
from reflectsep.scatter.filling import FILLINGS, Setting
from reflectsep.scatter.frames import name_of, signed_root
from reflectsep.scatter.gains import Gains, choose_samples, exponents, same_ratio, solve_gains
from reflectsep.scatter.geometry import crude_normals, surface_under
from reflectsep.scatter.local import box_sum, quantile
from reflectsep.scatter.options import ScatterOptions
from reflectsep.scatter.passage import Passage, speed_deviation, watch
from reflectsep.scatter.shared import summed, watched
from reflectsep.scatter.spread import Slab, extent, point_sampled

LEAST_COVERAGE = 0.9
DOUBTFUL = 0.6
"""A lit frame of a body that scatters all it does not reflect is about this part of what its light alone would give."""


@dataclass(frozen=True, kw_only=True)
class _Prepared:
    """A sweep before its second pass."""

    evidence: Evidence
    slab: Slab
    light: int
    gain: float
    reached: Bool[Tensor, "height width"]
    """Its sum holds all the light that the full picture has."""
    clipped_elsewhere: Bool[Tensor, "height width"]
    """Filled while the frames pass."""
    report: SweepReport


def measure_scattering(
    stack: PhotometricStack,
    sweeps: Sequence[FrameStream],
    *,
    options: ScatterOptions | None = None,
    progress: Progress = silent,
) -> Scattering:
    """Measure I_scat^(1/n_d) of every light of the stack from its sweeps (Eqs. 23 to 25).

    Args:
        stack: full pictures, linear, basis lights first.
        sweeps: frames developed to the same units, dark-subtracted; read twice each. At least one for every basis
            light; sweeps of one light along x and y are averaged. Kind `shadow` is taken from the full picture.
        options: settings; the defaults where None.
        progress: told after every frame.

    Returns:
        Roots of shape (lights, channels, height, width), zero off the object; measured where a light has a sweep,
        mixed by alpha (Eq. 15) where it has none. With it n_d, a report of every sweep, flags, and warnings.

    Raises:
        SweepError: a basis light without a sweep, a sweep without a full picture, too few frames, a frame of the
            wrong size or with values that are no numbers, or a sweep that is shorter than the object.
    """
    options = options or ScatterOptions()
    lights = _lights(stack, sweeps)
    with one_thread():
        return _measured(stack, sweeps, lights, options, progress)


def _measured(
    stack: PhotometricStack,
    sweeps: Sequence[FrameStream],
    lights: list[int],
    options: ScatterOptions,
    progress: Progress,
) -> Scattering:
    chosen = choose_samples(stack, lights)
    grid = torch.tensor(exponents(options), dtype=torch.float64)

    def passage(i: int) -> Passage:
        full = stack.images[lights[i]]
        return watch(sweeps[i], full, stack.mask, exponents=grid, samples=chosen[i], progress=progress)

    passages = watched(sweeps, passage)
    gains = solve_gains(stack, lights, passages, chosen, options)
    prepared = _prepare(stack, sweeps, lights, passages, gains, options, progress)
    warnings = list(gains.warnings) + _warn(prepared)
    normals = crude_normals(stack)

    def root_sum(i: int) -> tuple[Picture, Picture]:
        return _root_sum(stack, prepared[i], gains.n_d, options, normals)

    sums = summed([p.clipped_elsewhere for p in prepared], root_sum)
    root, root_sd, measured = _combine(stack, lights, sums)
    return Scattering(
        root=root,
        root_sd=root_sd,
        measured=measured,
        n_d=gains.n_d,
        n_d_sd=gains.n_d_sd,
        n_d_source=cast("str", gains.source),  # type: ignore[arg-type]
        sweeps=tuple(p.report for p in prepared),
        flags=_flags(stack, prepared),
        warnings=tuple(warnings),
    )


def _lights(stack: PhotometricStack, sweeps: Sequence[FrameStream]) -> list[int]:
    """Index of every sweep's light."""
    if not stack.mask.any():
        raise SweepError("the mask is empty: no pixel of the object to measure scattering at")
    swept = [stream.sweep.light for stream in sweeps]
    missing = [name for name in stack.names[:3] if name not in swept]
    if missing:
        raise SweepError(
            f"no sweep of basis light {', '.join(missing)}: expected one for each of {', '.join(stack.names[:3])}"
        )
    for stream in sweeps:
        if stream.sweep.light not in stack.names:
            raise SweepError(
                f"{name_of(stream.sweep)}: its light has no full picture; those there are {', '.join(stack.names)}"
            )
    return [stack.names.index(name) for name in swept]


def _prepare(
    stack: PhotometricStack,
    sweeps: Sequence[FrameStream],
    lights: list[int],
    passages: list[Passage],
    gains: Gains,
    options: ScatterOptions,
    progress: Progress,
) -> list[_Prepared]:
    steps_px = _steps_px(passages, stack.mask)
    if options.held is not None:
        steps_px = [options.held.of(p.sweep.light, p.sweep.direction).step_px for p in passages]
    slabs = _slabs(passages, gains, steps_px, options)
    prepared = []
    for i, (stream, k, passage) in enumerate(zip(sweeps, lights, passages, strict=True)):
        reached, coverage = _coverage(stack.images[k], passage, stack.mask)
        if coverage < LEAST_COVERAGE:
            raise SweepError(
                f"{name_of(stream.sweep)}: the slab reached {coverage:.0%} of the object, expected at least "
                f"{LEAST_COVERAGE:.0%}: the sweep is shorter than the object"
            )
        lit_frames, gain = gains.lit_frames[i], gains.gains[i]
        slab = slabs[i]
        # Frame over full picture of a pixel that the slab lights alone.
        ratio = (gain / (2 * slab.half)) ** gains.n_d
        level = options.threshold * ratio * stack.images[k].mean(0)
        lit = stack.mask & ((passage.narrow & (passage.peak > options.threshold * ratio)) | passage.clipped)
        band = LitBand(
            passage=passage,
            half=slab.half,
            edge=_edge(slab),
            lit=lit,
            doubtful=(passage.peak < DOUBTFUL * ratio) & ~passage.clipped,
            threshold=level if options.lit_band == "threshold" else None,
        )
        report = SweepReport(
            light=stream.sweep.light,
            direction=stream.sweep.direction,
            gain=gain,
            gain_sd=gains.gains_sd[i],
            lit_frames=lit_frames,
            speed_deviation=speed_deviation(passage, stack.images[k], stack.mask),
            coverage=coverage,
            step_px=steps_px[i],
        )
        elsewhere = torch.zeros_like(stack.mask)
        evidence = Evidence(
            stream=stream,
            full=stack.images[k],
            mask=stack.mask,
            band=band,
            n_d=gains.n_d,
            reach=options.reach_frames,
            clipped_elsewhere=elsewhere,
            progress=progress,
        )
        prepared.append(
            _Prepared(
                evidence=evidence,
                slab=slab,
                light=k,
                gain=gain,
                reached=reached,
                clipped_elsewhere=elsewhere,
                report=report,
            )
        )
    return prepared


def _steps_px(passages: list[Passage], mask: Tensor) -> list[float]:
    """Pixels a frame; sweeps along one axis share it where they nearly agree.

    Under a tilted light the near and the far flank of an object differ, so that its median is off, to either side
    according to the light; the rig moved the slab alike.
    """
    own = [p.step_px(mask) for p in passages]
    shared = []
    for i, passage in enumerate(passages):
        same = [own[j] for j, p in enumerate(passages) if p.sweep.direction == passage.sweep.direction]
        middle = float(torch.tensor(same).median())
        shared.append(middle if max(same) < 1.6 * min(same) else own[i])
    return shared


def _slabs(passages: list[Passage], gains: Gains, steps_px: list[float], options: ScatterOptions) -> list[Slab]:
    """The slab of every sweep; of one camera pixels are points in all of them or in none."""
    halves = []
    for gain, lit_frames in zip(gains.gains, gains.lit_frames, strict=True):
        equal = options.lit_frames is None and same_ratio(gain, lit_frames)
        halves.append(max(0.5, (gain if equal else lit_frames) / 2))
    seen = []
    for passage, half in zip(passages, halves, strict=True):
        kept, wide = passage.kept, extent(passage.centre)
        clear = passage.narrow.flatten()[kept.at] & ~kept.spoilt.any(0)
        at = kept.at[clear]
        seen.append((kept.value[:, clear], kept.index, passage.centre.flatten()[at], wide.flatten()[at], half))
    whole = point_sampled(seen)
    return [Slab(half=half, step_px=step, whole=whole) for half, step in zip(halves, steps_px, strict=True)]


def _edge(slab: Slab) -> float:
    """Frames around its edge in which a patch may be lit in part: half a pixel's extent, and the passage's error."""
    return min(max(0.5 / slab.step_px + 0.05, 0.15), 0.8 * slab.half) + slab.unsure


def _coverage(full: Tensor, passage: Passage, mask: Tensor) -> tuple[Tensor, float]:
    """Pixels whose light the sweep holds whole, and their part of those bright enough to tell."""
    grey, total = full.mean(0), passage.total.mean(0)
    bright = mask & (grey > max(0.03 * float(quantile(grey[mask], 0.99)), 1e-9))
    if not bright.any():
        return mask.clone(), 1.0
    reached = mask.clone()
    usable = bright & ~passage.clipped & ~passage.lost_near()
    if usable.any():
        # Means over neighbours: a faint pixel's noise says nothing about the sweep.
        near = box_sum(torch.stack([total, grey]) * usable)
        reached[usable] = complete(near[0][usable], near[1][usable])
    # Where the slab speeds up sums are smaller, but what it lit itself, not just before it stopped, it has passed.
    inside = (passage.centre > passage.first + 1) & (passage.centre < passage.last - 1)
    reached |= bright & inside & (passage.peak > 0.5 * quantile(passage.peak[bright], 0.95))
    return reached, float(reached[bright].float().mean())


def _warn(prepared: list[_Prepared]) -> list[str]:
    warnings = []
    for p in prepared:
        sweep, passage = p.evidence.stream.sweep, p.evidence.band.passage
        gaps = passage.last - passage.first + 1 - passage.received
        if gaps:
            warnings.append(f"{name_of(sweep)}: {gaps} frames lost; their scattering is interpolated")
        if p.report.coverage < 0.99:
            warnings.append(f"{name_of(sweep)}: the slab reached {p.report.coverage:.1%} of the object")
    return warnings


def _root_sum(
    stack: PhotometricStack, p: _Prepared, n_d: float, options: ScatterOptions, normals: Tensor | None
) -> tuple[Picture, Picture]:
    """The scattering root by one sweep, and its standard deviation by noise and method."""
    light = None if stack.light_vectors is None else stack.light_vectors[p.light]
    setting = Setting(
        slab=p.slab,
        distance_px=options.distance_px,
        noise=_root_noise(p, n_d),
        gain=p.gain,
        surface=surface_under(normals, light, stack.mask),
    )
    found, deviation = FILLINGS[options.hole_filling](p.evidence, setting)
    variance = deviation.square_() + _root_noise(p, n_d) ** 2 * _noisy_frames(p)
    return copied(found.mul_(stack.mask / p.gain)), copied(variance.sqrt_().mul_(stack.mask / p.gain))


def _root_noise(p: _Prepared, n_d: float) -> float:
    return float(signed_root(torch.tensor(p.evidence.band.passage.noise), n_d))


def _noisy_frames(p: _Prepared) -> Tensor:
    """Frames' variances in the sum: every C-th counts C times over, and those beside the slab for the hidden light."""
    tiled = min(2.0 * p.evidence.reach, p.evidence.band.passage.received) * (2 * p.slab.half)
    return p.evidence.band.passage.received + p.evidence.band.lit * (tiled + (3 * 2 * p.slab.half) ** 2)


def _combine(
    stack: PhotometricStack, lights: list[int], sums: list[tuple[Picture, Picture]]
) -> tuple[Tensor, Tensor, tuple[bool, ...]]:
    """Average the sweeps of each light; mix the lights without one from the basis."""
    measured = tuple(k in lights for k in range(len(stack.names)))
    root, variance = (empty(*stack.images.shape, dtype=stack.images.dtype) for _ in range(2))
    for k in set(lights):
        own = [i for i, light in enumerate(lights) if light == k]
        for c in range(root.shape[1]):
            root[k, c] = torch.stack([sums[i][0][c] for i in own]).mean(0)
            variance[k, c] = (torch.stack([sums[i][1][c] for i in own]) ** 2).sum(0) / len(own) ** 2
    alpha = stack.alpha.to(root)
    for j, has in enumerate(measured):
        for c in range(0 if has else root.shape[1]):
            root[j, c] = torch.einsum("k,khw->hw", alpha[j], root[:3, c])
            variance[j, c] = torch.einsum("k,khw->hw", alpha[j] ** 2, variance[:3, c])
    return root, variance.sqrt_(), measured


def _flags(stack: PhotometricStack, prepared: list[_Prepared]) -> Tensor:
    flags = stack.flags
    for p in prepared:
        flags = mark(flags, p.evidence.band.lit, Flag.HOLE_FILLED)
        flags = mark(flags, stack.mask & ~p.reached, Flag.NO_SWEEP_COVERAGE)
        flags = mark(flags, p.clipped_elsewhere & stack.mask, Flag.SWEEP_SATURATED)
    return flags
