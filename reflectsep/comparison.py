"""The compare job: a result beside Lin & Lee's, beside held-out pictures, and beside the truth where there is one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.calibrate.heldout import HeldOutPictures, Still
from reflectsep.calibrate.motion import Motion
from reflectsep.data import Capture
from reflectsep.errors import CaptureError
from reflectsep.export.harmonics import ptm_terms
from reflectsep.io.exr import read_channels
from reflectsep.io.lights import read_lights
from reflectsep.io.pictures import read_picture
from reflectsep.io.stack import windowed
from reflectsep.relight import LightMix, alphas_for, place_of
from reflectsep.report.figures import ComparisonRow, HeldOut, write_comparison
from reflectsep.report.metrics import psnr, relative_rms
from reflectsep.report.showcase import Apart, showcase_figure, write_figure
from reflectsep.separation import Separation

WEAK = 150.0
"""Condition number of a polynomial's terms from which the noise of the pictures is most of what it relights."""


def compare_result(
    ours: Separation,
    baseline: Separation,
    capture: Capture,
    pictures: HeldOutPictures | None,
    out: Path,
    *,
    still: Still,
) -> str:
    """Draw the figure; returns its numbers as text.

    `pictures` are the held-out lights' real pictures, where the capture has any. Pictures in the capture's `heldout/`
    folder, of the lights in its `heldout.json`, are compared as well, registered against `still`.
    """
    rows = [component_row(ours, baseline, i) for i in range(3)]
    relit = left_out(ours, baseline, capture, pictures) + beside(ours, baseline, capture, still)
    name = str(ours.document.get("object", ""))
    if baseline is ours:
        write_comparison(out, rows, relit, mask=ours.mask, title=f"{name}: Lin & Lee's model", baseline="")
    else:
        write_comparison(out, rows, relit, mask=ours.mask, title=name)
    return "\n".join([str(out), *compared_lines(ours, baseline, capture, relit)])


def show_result(ours: Separation, baseline: Separation, capture: Capture, out: Path, *, still: Still) -> str:
    """Draw the figure of `demo` for a simulated capture; returns its numbers as text.

    It shows the first basis light, and of the held-out lights between the basis lights the one that is farthest from
    all lights of the fit.

    Raises:
        CaptureError: the capture has no truth, or no held-out light.
    """
    truth = true_layers(capture, ours.basis[0], ours.d.shape[1])
    relit = {light.light: light for light in beside(ours, baseline, capture, still)}
    if not truth or not relit or ours.light_vectors is None:
        raise CaptureError(f"{capture.folder}: has no truth/ or no heldout/ pictures; simulate makes both")
    listed = read_lights(capture.folder / "heldout.json")
    towards = {name: listed[name].direction or (0.0, 0.0, 1.0) for name in relit}
    known = torch.nn.functional.normalize(ours.light_vectors.double(), dim=-1)
    mixes = alphas_for([listed[name] for name in relit], ours.light_vectors)
    inside = [name for name in relit if min(mixes[name].alpha) >= 0] or list(relit)
    chosen = min(inside, key=lambda name: float((known @ known.new_tensor(towards[name])).max()))
    figure = showcase_figure(
        apart_of(ours),
        Apart(
            photograph=apart_of(ours).photograph,
            specular=truth["specular"],
            # What a pixel away counts as scattering; what is left of it counts as local.
            local_diffuse=truth["local_diffuse"] + truth["scattering"] - truth["scattering_beyond_1px"],
            scattering=truth["scattering_beyond_1px"],
            highlight_free=truth["local_diffuse"] + truth["scattering"],
        ),
        apart_of(baseline),
        relit[chosen],
        mask=ours.mask,
        directions=(capture.lights[ours.basis[0]].direction or (0.0, 0.0, 1.0), towards[chosen]),
        words=f"{len(ours.names)} lights, {len(capture.sweeps)} of them\nswept by a slab",
    )
    write_figure(out, figure)
    return "\n".join([str(out), *compared_lines(ours, baseline, capture, list(relit.values()))])


def apart_of(separation: Separation) -> Apart:
    """The picture of the first basis light, and its components."""
    return Apart(
        photograph=separation.highlight_free[0] + separation.specular[0],
        specular=separation.specular[0],
        local_diffuse=separation.local_diffuse[0],
        scattering=separation.scattering[0],
        highlight_free=separation.highlight_free[0],
    )


def compared_lines(ours: Separation, baseline: Separation, capture: Capture, relit: list[HeldOut]) -> list[str]:
    """Numbers of every held-out light, a warning where a polynomial's mean nothing, and errors against the truth."""
    lines = []
    for light in relit:
        mask = ours.mask if light.counts is None else ours.mask & light.counts
        model = {"Lin & Lee": light.baseline}
        methods = model if baseline is ours else {"ours": light.ours} | model
        scores = [f"{name} {psnr(p, light.real, mask):5.1f} dB" for name, p in (methods | dict(light.others)).items()]
        said = "".join(f"; {words}" for words in (light.place, light.note) if words)
        lines.append(f"  {light.light:12s} {', '.join(scores)}{said}")
    return [*lines, *weak_polynomial(ours), *truth_lines(ours, baseline, capture)]


def weak_polynomial(ours: Separation) -> list[str]:
    """A line where the lights of the fit hardly tell the polynomial's terms apart, so that its figures mean little."""
    if ours.light_vectors is None:
        return []
    known = ptm_terms(ours.light_vectors / ours.light_vectors.norm(dim=-1, keepdim=True))
    condition = float(torch.linalg.cond(known.double()))
    if len(known) < known.shape[1] or condition <= WEAK:
        return []
    words = f"the {len(known)} lights hardly tell its {known.shape[1]} terms apart (condition number {condition:.0f})"
    return [f"  PTM          not a fair figure: {words}"]


def component_row(ours: Separation, baseline: Separation, i: int) -> ComparisonRow:
    """The paper's Figs. 4 and 6 for basis light i."""
    return ComparisonRow(
        light=ours.basis[i],
        original=ours.highlight_free[i] + ours.specular[i],
        scattering=ours.scattering[i],
        local_diffuse=ours.local_diffuse[i],
        specular=ours.specular[i],
        baseline_diffuse=baseline.diffuse[i],
        baseline_specular=baseline.specular[i],
    )


def left_out(
    ours: Separation, baseline: Separation, capture: Capture, pictures: HeldOutPictures | None
) -> list[HeldOut]:
    """Lights of the capture that the fit was told to leave out."""
    if pictures is None:
        return []
    mixes = alphas_for([capture.lights[name] for name in pictures.names], ours.light_vectors)
    rows = []
    for name, real, clipped, motion in zip(
        pictures.names, pictures.values, pictures.clipped, pictures.motions, strict=True
    ):
        row = held_out(name, real, ours, baseline, mixes[name], counts=~clipped.any(0))
        rows.append(replace(row, note=_undone(motion)))
    return rows


def beside(ours: Separation, baseline: Separation, capture: Capture, still: Still) -> list[HeldOut]:
    """Lights of `heldout.json`, whose pictures lie beside the capture in its own units."""
    listed = capture.folder / "heldout.json"
    if not listed.is_file() or ours.light_vectors is None:
        return []
    lights = read_lights(listed)
    mixes = alphas_for(list(lights.values()), ours.light_vectors) if lights else {}
    rows = []
    for name, mix in mixes.items():
        file = capture.folder / "heldout" / f"{name}.exr"
        if file.is_file():
            real, _ = read_picture(file)
            (part,) = windowed(file, capture.region, real)
            if part.shape != ours.d.shape[1:]:
                raise CaptureError(f"{file}: {tuple(part.shape)}, but the result is {tuple(ours.d.shape[1:])}")
            finite = torch.isfinite(real)
            real, bad, motion = still.place(torch.where(finite, real, 0.0), ~finite)
            row = held_out(name, real, ours, baseline, mix, counts=~bad.any(0))
            rows.append(replace(row, note=_undone(motion)))
    return rows


def _undone(motion: Motion) -> str:
    return f"its motion of {motion.displacement_px:.2f} px undone" if motion.applied else ""


def held_out(
    name: str, real: Tensor, ours: Separation, baseline: Separation, mix: LightMix, *, counts: Tensor
) -> HeldOut:
    """One light's real picture (channels, height, width) and the two models' under it; `counts` (height, width)."""
    alpha = torch.tensor(mix.alpha)
    plain = without_a_lobe(ours, alpha)
    return HeldOut(
        light=name,
        real=torch.where(counts, real, 0.0),
        ours=bounded(ours.relight(alpha), real),
        baseline=bounded(baseline.relight(alpha), real),
        counts=counts,
        place="" if ours.light_vectors is None else place_of(mix.alpha, ours.light_vectors, ours.view),
        others={name: bounded(picture, real) for name, picture in plain.items()},
    )


def without_a_lobe(ours: Separation, alpha: Float[Tensor, "3"]) -> dict[str, Float[Tensor, "channels height width"]]:
    """The light of mix `alpha` by least squares over the pictures that the fit saw, without a lobe, by name.

    A polynomial texture map (Malzbender, Gelb and Wolters 2001), and a Lambertian body without shadows; none where the
    lights are unknown or too few for the polynomial.
    """
    if ours.light_vectors is None:
        return {}
    vectors = ours.light_vectors.to(ours.d)
    intensity = vectors.norm(dim=-1, keepdim=True)
    pictures = (ours.relight(ours.alpha) + ours.residual) / intensity[..., None, None]
    lights, wanted = vectors / intensity, (alpha.to(vectors) @ vectors[:3])[None]
    strength = wanted.norm().clamp_min(1e-12)
    found = {}
    for name, terms in (("PTM", ptm_terms), ("Lambert", lambda directions: directions)):
        known = terms(lights)
        if int(torch.linalg.matrix_rank(known)) == known.shape[1]:
            mix = terms(wanted / strength) @ torch.linalg.pinv(known) * strength
            picture = torch.einsum("n,nchw->chw", mix[0], pictures)
            found[name] = picture.clamp_min(0.0) if name == "Lambert" else picture
    return found


def bounded(picture: Tensor, real: Tensor) -> Tensor:
    """`picture` with what is beyond 100 times the brightest real value (a lobe that overflows, say) set to that."""
    most = 100.0 * float(real.nan_to_num(nan=0.0, posinf=0.0).amax().clamp_min(1e-6))
    return picture.nan_to_num(nan=most, posinf=most).clamp(-most, most)


def truth_lines(ours: Separation, baseline: Separation, capture: Capture) -> list[str]:
    """Errors of the components where the capture knows its truth."""
    errors: dict[str, list[float]] = {}
    for i, name in enumerate(ours.basis):
        truth = true_layers(capture, name, ours.d.shape[1])
        if "specular" in truth:
            specular = truth["specular"]
            whole = ours.highlight_free[i] + ours.specular[i] - specular
            for key, picture, real in (
                ("specular, ours", ours.specular[i], specular),
                ("specular, Lin & Lee", baseline.specular[i], specular),
                ("diffuse, ours", ours.diffuse[i], whole),
                ("diffuse, Lin & Lee", baseline.diffuse[i], whole),
            ):
                errors.setdefault(key, []).append(relative_rms(picture, real, ours.mask))
        if "scattering_beyond_1px" in truth and bool(ours.scattering.any()):
            real = truth["scattering_beyond_1px"]
            errors.setdefault("scattering", []).append(relative_rms(ours.scattering[i], real, ours.mask))
    return [f"  error of {key:22s} {100 * sum(v) / len(v):5.1f} % of the truth" for key, v in errors.items()]


def true_layers(capture: Capture, light: str, channels: int) -> dict[str, Float[Tensor, "channels height width"]]:
    """Components of a light as the simulator knows them, by name; none where the capture does not know its truth."""
    file = capture.folder / "truth" / f"{light}.exr"
    if not file.is_file():
        return {}
    planes = read_channels(file)
    names = ("Y",) if channels == 1 else ("R", "G", "B")
    layers = {key.rsplit(".", 1)[0] for key in planes if key.endswith(f".{names[0]}")}
    whole = {
        layer: torch.stack([torch.from_numpy(planes[f"{layer}.{channel}"]).float() for channel in names])
        for layer in layers
    }
    return {layer: windowed(file, capture.region, picture)[0] for layer, picture in whole.items()}
