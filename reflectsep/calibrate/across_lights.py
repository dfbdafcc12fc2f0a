"""Motion between pictures under different lights: what does not change with the light is outline and structure.

In the logarithm, shading is a slowly varying summand: log(1 + I / small) = c log(1 + I_1 / small) + polynomial on the
object, robustly, which leaves out attached shadows and highlights. It starts from the outline alone. Where fine
structure agrees with it, the surface has texture, which is more exact and alone tells a rotation.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import avg_pool2d

from reflectsep.calibrate.align_options import MARGIN_PX, AlignOptions, grown, judged
from reflectsep.calibrate.motion import Model, Motion
from reflectsep.calibrate.pyramid import from_level
from reflectsep.calibrate.register import FEWEST_PIXELS, RegisterOptions, Registration, register
from reflectsep.errors import CaptureError

SMALL = 0.15
OUTLINE_SMALL = 0.06
"""Of the picture's bright end: below it values count as dark."""
OUTLINE_BLUR_PX = 1.5
SHADING_FLOOR_PX = 0.15
STRUCTURE_FLOOR_PX = 0.05
"""Systematic errors between pictures under different lights, beside which a motion must stand out: by outline and
shading, and by texture."""
STRUCTURE_PX = 3.0
MOST_PIXELS = 100_000
"""Pictures are halved until they are no larger: across lights a fifth of a pixel is the goal."""
AGREE_PX = 0.35
"""Fine structure that moves apart from outline and shading by more than this is no texture."""
DEGREE = 5
LARGEST_PICTURE = 1 << 19
"""Pixels; larger ones are halved before anything is made of them."""


def across(
    reference: Float[Tensor, "height width"],
    picture: Float[Tensor, "height width"],
    mask: Bool[Tensor, "height width"],
    options: AlignOptions | None = None,
) -> Motion:
    """Motion of a picture under another light against the reference.

    Args:
        reference: grey linear picture. Clipped values may be in both: they are bright, and outline and logarithm bear
            it.
        picture: the one that may have moved.
        mask: the object, in the reference.
        options: settings.
    """
    options = options or AlignOptions()
    factor = 1
    while reference.numel() > LARGEST_PICTURE and min(reference.shape) > 2:
        # Shading alone is two dozen maps of the picture's size, and only far smaller pictures are compared.
        reference, picture = (avg_pool2d(each[None], 2)[0] for each in (reference, picture))
        mask = avg_pool2d(mask[None].float(), 2)[0] > 0.5
        factor *= 2
    found = _across(reference, picture, mask, options)
    if factor == 1:
        return found
    return replace(
        found,
        matrix=from_level(found.matrix, factor),
        displacement_px=factor * found.displacement_px,
        sd_px=factor * found.sd_px,
    )


def _across(reference: Tensor, picture: Tensor, mask: Tensor, options: AlignOptions) -> Motion:
    """`across` of pictures that are no larger than `LARGEST_PICTURE`."""
    usable = grown(mask, MARGIN_PX)
    models: tuple[Model, ...] = options.models[:3]  # up to a rigid motion
    try:
        outline = register(
            _outline(picture, mask),
            _polynomials(mask, 3),
            usable=usable,
            options=RegisterOptions(models=("translation",), blur_px=OUTLINE_BLUR_PX, most_pixels=MOST_PIXELS),
        )
        shaded = partial(
            register,
            _logarithm(picture, mask),
            torch.cat([_logarithm(reference, mask)[None], _polynomials(mask, DEGREE)]),
            usable=usable,
            start=outline.matrix,
        )
        # Beyond a shift, what two lights do to an outline and to shading is more than a camera does.
        measured = shaded(options=RegisterOptions(models=("translation",), most_pixels=MOST_PIXELS))
        structure = _structure(reference, picture, mask, models, measured)
        if structure is not None:
            return judged(structure, mask)
        tested = RegisterOptions(models=("identity", "translation"), floor_px=SHADING_FLOOR_PX, most_pixels=MOST_PIXELS)
        return judged(shaded(options=tested), mask)
    except CaptureError as error:
        return Motion(reason=str(error))


def _structure(
    reference: Tensor, picture: Tensor, mask: Tensor, models: tuple[Model, ...], measured: Registration
) -> Registration | None:
    """The motion of the surface's fine structure; None where that structure goes with the light and not the surface.

    On a bumpy object without texture fine structure is shading, which moves by pixels with the light: then it does not
    agree with outline and logarithm.
    """
    inner = ~grown(~mask, round(STRUCTURE_PX) + 2)
    if int(inner.sum()) < FEWEST_PIXELS:
        return None
    found = register(
        _fine(picture, mask),
        _fine(reference, mask)[None],
        usable=inner,
        options=RegisterOptions(
            models=models,
            blur_px=1.0,
            floor_px=STRUCTURE_FLOOR_PX,
            lenient_turn=False,
            levels=0,
            most_pixels=MOST_PIXELS,
        ),
        start=measured.matrix,
    )
    rows, columns = mask.nonzero(as_tuple=True)
    middle = torch.stack([columns.double().mean(), rows.double().mean(), torch.tensor(1.0, dtype=torch.float64)])
    apart = float((found.matrix @ middle - measured.matrix @ middle)[:2].norm())
    return found if apart <= AGREE_PX else None


def _fine(picture: Tensor, mask: Tensor) -> Tensor:
    """The logarithm without what is coarser than `STRUCTURE_PX`."""
    values = _logarithm(picture, mask)
    size = 2 * round(3 * STRUCTURE_PX) + 1
    size = min(size, 2 * ((min(values.shape) - 1) // 2) + 1)
    blur = (STRUCTURE_PX, STRUCTURE_PX)
    return values - gaussian_blur2d(values[None, None], (size, size), blur, border_type="replicate")[0, 0]


def _bright(picture: Tensor, mask: Tensor) -> Tensor:
    values = picture[mask]
    return values.kthvalue(max(1, round(0.9 * values.numel()))).values.clamp_min(1e-12)


def _outline(picture: Tensor, mask: Tensor) -> Tensor:
    """Nearly 1 on whatever is lit, 0 where it is dark."""
    positive = picture.clamp_min(0)
    return positive / (positive + OUTLINE_SMALL * _bright(picture, mask))


def _logarithm(picture: Tensor, mask: Tensor) -> Tensor:
    return torch.log1p(picture.clamp_min(0) / (SMALL * _bright(picture, mask)))


def _polynomials(mask: Tensor, degree: int) -> Tensor:
    """x^i y^k on the object, i + k up to `degree`."""
    height, width = mask.shape
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height, dtype=torch.float64),
        torch.linspace(-1, 1, width, dtype=torch.float64),
        indexing="ij",
    )
    inside_ = mask.double()
    full = bool(mask.all())  # then the constant is the solver's own
    orders = [(i, k) for i in range(degree + 1) for k in range(degree + 1 - i) if not (full and i == k == 0)]
    return torch.stack([inside_ * x**i * y**k for i, k in orders])
