"""How the reflectance problem is to be solved."""

from dataclasses import dataclass
from typing import Literal

from reflectsep.data import Learnt


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Choices of a fit; the defaults are the method at its best, the others the paper's own and the baseline's."""

    method: Literal["joint", "two_step"] = "joint"
    """All parameters together, or globals on chosen pixels first and then every pixel on its own (paper, section 5)."""
    scattering: Literal["measured", "none", "unknown"] = "measured"
    """s from the sweeps; left out (Lin & Lee); or fitted, seven unknowns a pixel (n >= 8)."""
    scattering_sd: float = 0.03
    """Relative standard deviation of the measured s, beside the noise of its frames. d is what the small difference
    between the picture and s leaves, so an error of 3 % in s is one of 10 % in d, and of as much in the direction that
    d gives the lobe; s is fitted within this. 0 holds s as measured: the paper's four unknowns a pixel."""
    n_s: float | None = None
    """Fixed exponent of the lobe; None: fitted."""
    refine_n_d: bool = False
    """Fit n_d as a fifth global, from where the sweeps put it."""
    alpha_sd: float = 0.0
    """Standard deviation of the stated alphas of the lights beside the basis (of lights of unit intensity, so about
    that of their directions, in radians, and relative intensities), within which the joint fit refines them, three
    more globals a light. 0 holds them."""
    weights: Literal["paper", "noise"] = "paper"
    """lambda of Eq. 22, or one weight for all pictures."""
    lambda_basis: float = 1.0
    lambda_other: float = 2.0
    robust: Literal["huber", "none"] = "huber"
    """Loss of the pictures' residuals."""
    lobe: Literal["auto", "ggx", "single"] = "auto"
    """The paper's lobe, a power of a cosine, or that of GGX microfacets, and soft shadow edges where they pay; or the
    paper's formula alone."""
    prior: Literal["auto", "none"] = "auto"
    """Priors of a strength taken from the data, or none but a bound on the lobe."""
    max_iterations: int = 20
    """Limit of every joint solve."""
    tolerance: float = 1e-6
    globals_pixels: int = 300
    chunk: int = 1 << 12
    """Pixels times channels at once: enough for the calls to be cheap beside the arithmetic."""
    dtype: Literal["float32", "float64"] = "float64"
    device: Literal["cpu", "cuda"] = "cpu"
    """Where chunks are searched and solved; what is kept of all pixels, and all other work, is the processor's."""
    compile: Literal["auto", "always", "never"] = "auto"
    """The solver of all pixels as a compiled loop: from `WORTH_COMPILING` values on (pixels times channels), on the
    processor, where there is a C++ compiler. It takes the same steps but for rounding."""
    given: Learnt | None = None
    """What another fit has learnt of the same object."""
    globals: Literal["held", "start"] = "held"
    """Where something is given: its globals, noise and strengths of priors are those of this fit, or its globals are
    where this fit starts."""

    @property
    def held(self) -> Learnt | None:
        """What is given, where nothing of it is fitted again."""
        return self.given if self.globals == "held" else None
