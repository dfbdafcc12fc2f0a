"""What to do about each warning of a result."""

from __future__ import annotations

ADVICE = (
    (
        "no sweeps",
        "Sweep the three basis lights with a slab and fit again; until then read the diffuse part as a whole.",
    ),
    (
        "pixels show the highlight",
        "Add lights whose mirror direction the surface faces, or lights closer to the camera; compare with "
        "fit=lin_lee.",
    ),
    (
        "show no lobe that all",
        "Check the light directions (a chrome ball: reflectsep calibrate), and whether pictures are clipped.",
    ),
    ("stopped at its limit", "Fit again with a larger fit.max_iterations, and look whether the globals change."),
    (
        "light directions are unknown",
        "Give directions in the capture or by lights_file=FILE; a chrome sphere in a picture tells them.",
    ),
    ("n_d cannot be told", "Expected on an opaque object. Otherwise fix it by scatter.n_d=1 for a linear camera."),
    (
        "not from Eq. 25",
        "Expose the slab frames so that lit pixels are not clipped, or write exposure_s of pictures and sweeps.",
    ),
    ("frames lost", "Nothing, where few are lost; where they lie on the object, sweep again."),
    ("the slab reached", "Sweep farther than the object on both sides; pixels never lit have a lower bound alone."),
    ("no sweep of", "Sweep that light along the other axis as well, or use scatter=profile."),
    (
        "clipped in more frames",
        "Expose the slab frames shorter, or narrow the slab; what is clipped tells no scattering.",
    ),
    ("not registered", "Nothing, where the rig stood still; otherwise expose so that less is clipped and sweep again."),
    ("as a mix of", "The direction given for that light is used; look at its picture: clipping, shadow, a wrong name?"),
    ("no dark picture", "Take a dark picture of that exposure: offset and ambient light add up over the frames."),
    ("do not tell alpha apart", "The directions given are used instead; nothing to do if they are trusted."),
    ("not identifiable", "Sweep the basis lights, or take the split where no highlight is seen as arbitrary."),
)
GENERAL = "Look at the section on this below, and at the limits that the README lists."


def what_to_do(warning: str) -> str:
    """Advice for a warning of a result, one or two sentences."""
    return next((advice for words, advice in ADVICE if words in warning), GENERAL)
