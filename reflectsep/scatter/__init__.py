"""Scattering from slab sweeps (paper, section 6): exponent and gain, lit band, hole filling."""

from reflectsep.scatter.measure import measure_scattering
from reflectsep.scatter.options import ScatterOptions

__all__ = ["ScatterOptions", "measure_scattering"]
