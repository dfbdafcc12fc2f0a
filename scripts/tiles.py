"""Fit a large capture in overlapping tiles, under the globals of one first fit, and put them together.

    python scripts/tiles.py capture=captures/wall out=results/wall columns=4 rows=3 [overlap_px=24] [cut=feathered]
        [globals_from=RESULT] [only=5] [overwrite=true]

Beside the result its parts stand in OUT.tiles: `first`, a fit of squares strewn over the object whose globals are held,
unless `globals_from` names another result, and `tile_1` and so on, row by row. Parts that are there are not fitted
again. `only` fits one tile and puts nothing together: tiles can be fitted side by side, also on several machines.
"""

from __future__ import annotations

import sys

KEYS = ("capture", "out", "columns", "rows", "overlap_px", "cut", "globals_from", "only", "overwrite")


def main(words: list[str]) -> int:
    """Fit, and say what was found."""
    import torch

    from reflectsep.config import FitJob, FitSettings
    from reflectsep.errors import ReflectsepError
    from reflectsep.tiling import TilesJob, Tiling, run_tiles

    given: dict[str, str] = {}
    for word in words:
        key, _, value = word.partition("=")
        given[key] = value
    wrong = sorted(given.keys() - set(KEYS))
    if wrong or not {"capture", "out", "columns", "rows"} <= given.keys():
        print(f"capture, out, columns and rows are needed; unknown: {', '.join(wrong) or 'none'}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    try:
        numbers = {name: int(given[name]) for name in ("columns", "rows", "overlap_px", "only") if name in given}
        if given.get("cut", "feathered") not in ("feathered", "hard"):
            raise ValueError(f"cut={given['cut']}: expected feathered or hard")
        only = numbers.pop("only", None)
        tiling = Tiling(**numbers, cut="hard" if given.get("cut") == "hard" else "feathered")
        job = FitJob(
            capture=given["capture"],
            out=given["out"],
            overwrite=given.get("overwrite") == "true",
            fit=FitSettings(globals_from=given.get("globals_from")),
        )
        print(run_tiles(TilesJob(fit=job, tiling=tiling, only=only)))
    except (ReflectsepError, ValueError) as error:
        print(f"tiles: error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
