"""The simulate job: settings of the command to a simulated object and rig."""

from __future__ import annotations

from pathlib import Path

from reflectsep.config import RigSettings, SimulateJob
from reflectsep.errors import SettingsError
from reflectsep.io.files import refuse_folder
from reflectsep.progress import Progress
from reflectsep.synth.drift import Drift
from reflectsep.synth.paper import PaperObject, paper_rig, simulate_paper
from reflectsep.synth.presets import make_object
from reflectsep.synth.rig import SimulatedCamera, SimulatedRig, make_rig
from reflectsep.synth.simulate import simulate


def write(job: SimulateJob, progress: Progress) -> str:
    """Write the capture of a job; returns a line that says what was written.

    Raises:
        ResultError: the folder exists and may not be replaced.
        SettingsError: an object or rig that cannot be.
    """
    out = Path(job.out)
    refuse_folder(out, job.overwrite)
    if job.rig.sweeps > job.rig.lights:
        raise SettingsError(f"rig.sweeps={job.rig.sweeps}: must be at most rig.lights={job.rig.lights}")
    if job.mode == "paper":
        obj = PaperObject(name=job.object.name or "paper", size=job.object.size_px, channels=job.object.channels)
        rig: SimulatedRig = paper_rig(job.rig.lights, sigma=job.rig.read_noise, sweeps=job.rig.sweeps)
        simulate_paper(obj, rig, out, seed=job.seed, overwrite=job.overwrite, progress=progress)
    else:
        size = job.object.size_px * job.rig.oversample
        made = make_object(job.object.preset, size=size, channels=job.object.channels)
        rig = rig_of(job.rig)
        simulate(made, rig, out, seed=job.seed, overwrite=job.overwrite, progress=progress)
    return f"{out}: {len(rig.lights)} pictures, {len(rig.sweeps)} sweeps, {len(rig.heldout)} held-out lights, the truth"


def rig_of(settings: RigSettings) -> SimulatedRig:
    """The simulated rig that the settings describe."""
    full_well = None
    if settings.shot_noise > 0:
        full_well = 1.0 / settings.shot_noise**2
    camera = SimulatedCamera(
        full_exposure_s=settings.full_exposure_s,
        slab_exposure_s=settings.sweep_exposure_s,
        peak=1.0 / settings.headroom,
        dark_level=settings.dark_level,
        read_sigma=settings.read_noise,
        full_well_e=full_well,
        bits=settings.bits,
        gamma=settings.gamma,
        oversample=settings.oversample,
    )
    return make_rig(
        settings.name,
        lights=settings.lights,
        basis_tilt_deg=settings.basis_angle_deg,
        spread_deg=(min(12.0, settings.spread_deg), settings.spread_deg),
        heldout=(settings.heldout, 1 if settings.heldout else 0),
        sweeps=(settings.sweeps, settings.sweeps if settings.orthogonal else 0),
        slab_px=(settings.slab_width_px, settings.slab_step_px),
        camera=camera,
        drift=Drift(
            between_px=settings.drift_px,
            between_deg=settings.drift_deg,
            across_px=settings.drift_across_px,
            across_deg=settings.drift_across_deg,
            within_px=settings.drift_within_px,
        ),
    )
