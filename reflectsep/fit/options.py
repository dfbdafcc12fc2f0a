"""How the reflectance problem is to be solved."""

from dataclasses import dataclass
from typing import Literal

from reflectsep.data import Learnt


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Choices of a fit: the model with all of its globals fitted, unless something is held."""

    method: Literal["joint", "two_step"] = "joint"
    """All parameters together, or globals on chosen pixels first and then every pixel on its own (paper, section 5)."""
    scattering: Literal["measured", "none", "unknown"] = "measured"
    """s from the sweeps; left out (Lin & Lee); or fitted, with s three more unknowns a pixel and channel (n >= 8)."""
    lobe: Literal["ggx", "power"] = "ggx"
    """That of GGX microfacets, or the paper's power of a cosine."""
    shading: Literal["fitted", "lambert"] = "fitted"
    """Fresnel's share and soft shadow edges are fitted; or the paper's clamp alone."""
    n_s: float | None = None
    """Fixed exponent of the lobe; None: fitted."""
    f: float | None = None
    """Share of the scattered light that has forgotten the normal: 0 as in Lin & Lee, 1 as in the paper; None: fitted.
    Fitted, it is drawn to what is wrong with s, and highlights that no picture saw are then misplaced: the command
    holds 0."""
    materials: int | None = None
    """Number of materials, each with a height and an exponent of its own; None: as many as the pictures want."""
    refine_n_d: bool = False
    """Fit n_d too, from where the sweeps put it."""
    alpha_sd: float = 0.0
    """Standard deviation of the stated alphas of the lights beside the basis (of lights of unit intensity, so about
    that of their directions, in radians, and relative intensities), within which the joint fit refines them, three
    more globals a light. 0 holds them."""
    lambda_basis: float = 1.0
    lambda_other: float = 1.0
    """Weights of Eq. 22; 1 and 2 in the paper."""
    robust: Literal["huber", "none"] = "huber"
    """Loss of the pictures' residuals."""
    prior: Literal["auto", "none"] = "auto"
    """What is expected of highlights (one height, alike in neighbours), its strength from the data; or nothing."""
    max_iterations: int = 30
    """Limit of every solve."""
    tolerance: float = 1e-6
    chunk: int = 1 << 12
    """Pixels at once: enough for the calls to be cheap beside the arithmetic."""
    dtype: Literal["float32", "float64"] = "float64"
    given: Learnt | None = None
    """What another fit has learnt of the same object."""
    globals: Literal["held", "start"] = "held"
    """Where something is given: its globals, noise and strengths of priors are those of this fit, or its globals are
    where this fit starts."""

    @property
    def held(self) -> Learnt | None:
        """What is given, where nothing of it is fitted again."""
        return self.given if self.globals == "held" else None
