"""How well tiles fit together: tiles under globals of their own and under held ones, against the fit of the whole.

    python scripts/seams.py capture=captures/wax whole=results/wax out=seams [columns=2] [rows=2] [overlap_px=24]

Three sets of tiles: `own` (every tile its own globals, C and priors), `strewn` (held, those of a fit of squares
that are strewn over the object, as much of it as a tile), `whole` (held, those of the result `whole`). All move as the
whole does. Printed are RMS differences over the RMS on the whole object, of off-specular, whole diffuse and scattered
light, and of lights halfway between the basis lights relit:

    cut    hard cuts against the whole, within 3 pixels of a cut
    away   the same farther than an overlap from any cut
    step   of two tiles from each other along a cut, where both have the pixels

Parts that are there are not fitted again.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from reflectsep.data import Region
    from reflectsep.separation import Separation
    from reflectsep.tiling import Tiling

NEAR_PX = 3


def main(words: list[str]) -> int:
    """Fit what is not there, and print a table."""
    import torch

    from reflectsep.config import FitJob, FitSettings
    from reflectsep.separation import load
    from reflectsep.tiling import TilesJob, Tiling, run_tiles

    given = dict(word.split("=", 1) for word in words)
    wrong = sorted(given.keys() - {"capture", "whole", "out", "columns", "rows", "overlap_px"})
    if wrong or not {"capture", "whole", "out"} <= given.keys():
        print(f"capture, whole and out are needed; unknown: {', '.join(wrong) or 'none'}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    tiling = Tiling(
        columns=int(given.get("columns", "2")),
        rows=int(given.get("rows", "2")),
        overlap_px=int(given.get("overlap_px", "24")),
        cut="hard",
    )
    whole = load(given["whole"])
    size = whole.mask.shape[1], whole.mask.shape[0]
    out = Path(given["out"])
    print(f"{'globals':8s} {'part':12s} {'cut':>8s} {'away':>8s} {'step':>8s}", flush=True)
    for name in ("whole", "strewn", "own"):
        folders = [out / f"{name}.tiles" / f"tile_{i}" for i in range(1, tiling.columns * tiling.rows + 1)]
        if name == "own":
            fit_own(given["capture"], whole, tiling.regions(size), folders)
        elif not (out / name).is_dir():
            settings = FitSettings(globals_from=given["whole"] if name == "whole" else None)
            run_tiles(TilesJob(fit=FitJob(capture=given["capture"], out=str(out / name), fit=settings), tiling=tiling))
        table(name, whole, [load(folder) for folder in folders], tiling)
    return 0


def fit_own(capture: str, whole: Separation, regions: list[Region], folders: list[Path]) -> None:
    """Tiles that share nothing but the motions of the pictures."""
    from reflectsep.io.capture import load_capture
    from reflectsep.pipeline import fit
    from reflectsep.recorded import recorded_alignment

    found = recorded_alignment(whole)
    assert found is not None
    for region, folder in zip(regions, folders, strict=True):
        if not folder.is_dir():
            motions = found.in_window(region.x, region.y, (region.width, region.height))
            fit(load_capture(capture, region=region.plain()), alignment=motions).save(folder)


def pictures_of(separation: Separation) -> dict[str, Tensor]:
    """What is compared."""
    import torch

    between = torch.tensor([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]])
    parts = {name: getattr(separation, name) for name in ("specular", "diffuse", "scattering")}
    return {**parts, "relit": separation.relight(between)}


def table(name: str, whole: Separation, parts: list[Separation], tiling: Tiling) -> None:
    """Print a line a component."""
    import torch

    from reflectsep.tiling import mixed, shares

    size = whole.mask.shape[1], whole.mask.shape[0]
    regions = tiling.regions(size)
    share = shares(regions, [part.mask for part in parts], size, tiling)
    owner = mixed([torch.full_like(s, float(i + 1)) for i, s in enumerate(share)], regions, share, size)
    near, far = distances(owner, whole.mask, tiling.overlap_px)
    of_parts, of_whole = [pictures_of(part) for part in parts], pictures_of(whole)
    for key, reference in of_whole.items():
        joined = mixed([each[key] for each in of_parts], regions, share, size)
        steps = []
        for i, first in enumerate(regions):
            for j in range(i):
                second = regions[j]
                both = torch.zeros(2, *whole.mask.shape, dtype=torch.bool)
                pair = torch.zeros(2, *reference.shape)
                for k, (index, region) in enumerate(((i, first), (j, second))):
                    both[k, region.rows, region.columns] = parts[index].mask
                    pair[k][..., region.rows, region.columns] = of_parts[index][key]
                shared = both.all(0) & beside(owner == i + 1, NEAR_PX) & beside(owner == j + 1, NEAR_PX)
                if bool(shared.any()):
                    steps.append((pair[0] - pair[1])[..., shared].flatten())
        size_of = float(reference[..., whole.mask].square().mean().sqrt())
        step = float(torch.cat(steps).square().mean().sqrt()) / size_of
        off = joined - reference
        cut, away = (float(off[..., where].square().mean().sqrt()) / size_of for where in (near, far))
        print(f"{name:8s} {key:12s} {100 * cut:7.2f}% {100 * away:7.2f}% {100 * step:7.2f}%", flush=True)


def beside(where: Tensor, pixels: int) -> Tensor:
    """Pixels within so many of those in `where`, in a square."""
    import torch

    return torch.nn.functional.max_pool2d(where[None].float(), 2 * pixels + 1, 1, pixels)[0] > 0


def distances(owner: Tensor, mask: Tensor, overlap: int) -> tuple[Tensor, Tensor]:
    """Pixels of the object within `NEAR_PX` of a cut between tiles, and those farther than `overlap` from any."""
    import torch

    def reach(pixels: int) -> Tensor:
        inner = torch.where(mask, owner, torch.nan)
        high = torch.nn.functional.max_pool2d(inner.nan_to_num(-9.0)[None], 2 * pixels + 1, 1, pixels)[0]
        low = -torch.nn.functional.max_pool2d(-inner.nan_to_num(9e9)[None], 2 * pixels + 1, 1, pixels)[0]
        return mask & (high > low)

    return reach(NEAR_PX), mask & ~reach(overlap)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
