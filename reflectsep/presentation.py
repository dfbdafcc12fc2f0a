"""The jobs that show a result: the relighting page."""

from __future__ import annotations

from pathlib import Path

from reflectsep.config import ViewJob
from reflectsep.errors import SettingsError
from reflectsep.io.files import refuse_existing
from reflectsep.progress import Progress
from reflectsep.report.tone import white_point
from reflectsep.separation import Separation, load
from reflectsep.viewer.page import Shown, write_page


def view(job: ViewJob, progress: Progress) -> str:
    """Write the relighting page of a job; returns lines that say what was written and how exact it is.

    Raises:
        ResultError: a result that is missing or damaged, or a page that is there and may not be replaced.
        SettingsError: a result compared with itself.
    """
    out = Path(job.out)
    refuse_existing(out, job.overwrite)
    folders = [Path(job.result)] + ([] if job.other is None else [Path(job.other)])
    if len(folders) == 2 and folders[0].resolve() == folders[1].resolve():
        raise SettingsError(f"other={job.other}: is the result itself; give another one to compare with")
    results = [shown(load(folder), folder.resolve().name) for folder in folders]
    exact = write_page(
        out, results, max_pixels=round(1e6 * job.max_megapixels), measured=job.measured, progress=progress
    )
    lines = [f"{out}: {out.stat().st_size / 1e6:.1f} MB; open it in a browser, it needs nothing else"]
    for result, found in zip(results, exact, strict=True):
        lines.append(
            f"  {result.name}: basis lights {found.psnr_db:.1f} dB from the result, "
            f"{100 * found.within_one:.2f} % of the values within one of 255 steps"
        )
    return "\n".join(lines)


def shown(separation: Separation, name: str) -> Shown:
    """A result as it goes into a page: its white is that of its basis pictures."""
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    return Shown(name=name, separation=separation, white=white)
