"""The simulated camera: noise-free values in, stored pictures out.

Noise is drawn from the capture's seed and the picture's name, so that a picture does not depend on which others were
taken before it.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.io.pictures import write_picture
from reflectsep.synth.rig import SimulatedCamera

MANY_E = 1000.0
"""Electrons from which noise is drawn from the normal law: a Poisson law's skewness is 3 % there, and less above."""


def exposed(
    camera: SimulatedCamera,
    values: Float[Tensor, "channels height width"],
    exposure_s: float,
    *,
    sigma: float,
    rng: np.random.Generator,
    average: int = 1,
) -> Float[Tensor, "channels height width"]:
    """One exposure as the sensor gives it: linear, noisy, clipped; neither encoded nor quantised.

    Args:
        camera: The camera.
        values: Noise-free values at the full pictures' exposure; 0 is no light.
        exposure_s: Exposure of this picture.
        sigma: Gaussian noise as a share of the peak.
        rng: Source of all noise.
        average: Number of exposures whose mean this is.

    Returns:
        Values, float64; 1 is full scale. A float camera's may be below 0, an integer camera's not.
    """
    scene = values.numpy() * (exposure_s / camera.full_exposure_s) + camera.ambient_per_s * exposure_s
    total = np.zeros_like(scene)
    for _ in range(average):
        shot = scene
        if camera.full_well_e is not None:
            # Negative light, which only data made by formula has, knows no shot noise.
            shot = electrons(np.maximum(scene, 0) * camera.full_well_e, rng) / camera.full_well_e
            shot += np.minimum(scene, 0)
        deviation = math.hypot(camera.read_sigma, sigma * camera.peak)
        if deviation > 0:
            shot = shot + deviation * rng.standard_normal(scene.shape, dtype=np.float32)
        shot = shot + camera.dark_level
        total += clipped(camera, shot)
    return torch.from_numpy(total / average)


def electrons(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Numbers of electrons, Poisson about their mean; by the normal law from `MANY_E`, where it is nearly the same."""
    lit = mean > 0
    counts = mean[lit]
    few = counts < MANY_E
    drawn = rng.poisson(counts[few])
    counts += np.sqrt(counts) * rng.standard_normal(counts.shape, dtype=np.float32)
    counts[few] = drawn
    result = np.zeros_like(mean)
    result[lit] = counts
    return result


def clipped(camera: SimulatedCamera, values: np.ndarray) -> np.ndarray:
    """Values as far as the sensor reaches: up to its saturation, and, for an integer camera, down to 0."""
    largest = camera.saturation or (1.0 if camera.bits else np.inf)
    return np.clip(values, 0.0 if camera.bits else -np.inf, largest)


def encoded(camera: SimulatedCamera, values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Values through the camera's curve; sign kept, for a float camera's dark pixels are noise around 0."""
    if camera.gamma is None:
        return values
    return values.sign() * values.abs() ** (1 / camera.gamma)


def store(camera: SimulatedCamera, path_without_suffix: Path, values: Float[Tensor, "channels height width"]) -> Path:
    """Encode, quantise and write one picture: `.exr` (float32) or `.png` (of 8 bits, or of 16 for more).

    A 12-bit code k is stored as the 16-bit value nearest to k 65535 / 4095, so that readers need not know the depth.

    Returns:
        The file written.
    """
    signal = encoded(camera, values)
    path = path_without_suffix.with_name(path_without_suffix.name + suffix(camera))
    if camera.bits is None:
        write_picture(path, signal.to(torch.float32))
        return path
    codes = np.rint(np.clip(signal.numpy(), 0, 1) * (2**camera.bits - 1))
    kind, largest = (np.uint8, 255) if camera.bits <= 8 else (np.uint16, 65535)
    write_picture(path, torch.from_numpy(np.rint(codes * (largest / (2**camera.bits - 1))).astype(kind)))
    return path


def suffix(camera: SimulatedCamera) -> str:
    """Of the files that the camera writes."""
    return ".exr" if camera.bits is None else ".png"


def noise(seed: int, picture: str) -> np.random.Generator:
    """The noise source of one picture of one capture."""
    return np.random.default_rng([seed, zlib.crc32(picture.encode())])
