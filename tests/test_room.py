"""Large tensors in nameless files: the same tensors, gone when they are, and a full disk said in one line."""

from pathlib import Path

import pytest
import torch

from reflectsep import room
from reflectsep.room import by_rows, copied, empty, room_beside, rows, stacked


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with room for everything from 1 kB on."""
    monkeypatch.setattr(room, "LEAST_BYTES", 1000)
    with room_beside(tmp_path / "not" / "there" / "yet" / "out"):
        yield tmp_path


def files_of(folder: Path) -> int:
    """Mapped files of `folder`, with or without a name."""
    return sum(str(folder) in line for line in Path("/proc/self/maps").read_text().splitlines())


def test_small_tensors_are_memory_and_large_ones_files(folder):
    kept = empty(124, dtype=torch.float64)
    assert files_of(folder) == 0
    kept = [kept, empty(125, dtype=torch.float64)]
    assert files_of(folder) == 1
    kept = [*kept, empty(10, 100, dtype=torch.bool)]
    assert files_of(folder) == 2
    assert [tuple(t.shape) for t in kept] == [(124,), (125,), (10, 100)]
    assert [t.dtype for t in kept] == [torch.float64, torch.float64, torch.bool]


def test_files_have_no_name_and_go_with_the_last_view(folder):
    tensor = empty(1000, 3, dtype=torch.float32)
    tensor.copy_(torch.arange(3000.0).view(1000, 3))
    view = tensor[5:, 1]
    del tensor
    assert list(folder.iterdir()) == []
    assert files_of(folder) == 1
    assert torch.equal(view, torch.arange(16.0, 3000.0, 3.0))
    del view
    assert files_of(folder) == 0


def test_without_a_place_for_files_everything_is_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(room, "LEAST_BYTES", 0)

    with room_beside(tmp_path / "out"):
        inside = empty(10_000, dtype=torch.uint8)
        assert files_of(tmp_path) == 1
    outside = empty(10_000, dtype=torch.uint8)
    assert files_of(tmp_path) == 1
    assert len(inside) == len(outside)


def test_a_disk_without_room_is_said_before_anything_is_written(folder):
    with pytest.raises(OSError, match=r"no room for 1048576\.0 GiB of maps \(.+\)") as found:
        empty(1 << 50, dtype=torch.uint8)  # no file system has that
    assert found.value.filename == str(folder)
    assert found.value.errno
    assert list(folder.iterdir()) == []
    assert files_of(folder) == 0


@pytest.mark.parametrize("large", [False, True])
def test_rows_copies_stacks_and_parts_are_what_they_say(folder, monkeypatch, large):
    monkeypatch.setattr(room, "LEAST_BYTES", 1 if large else 1 << 30)
    values = torch.randn(500, 4, generator=torch.Generator().manual_seed(0))
    assert rows(7, values).shape == (7, 4)
    again = copied(values)
    values_before = values.clone()
    again += 1.0
    assert torch.equal(values, values_before)
    assert torch.equal(again, values + 1.0)
    assert torch.equal(stacked((values[i::5] for i in range(5)), 5), torch.stack([values[i::5] for i in range(5)]))
    parts = by_rows(500, 33, lambda cut: values[cut].sum(-1) > 0)
    assert torch.equal(parts, values.sum(-1) > 0)
    assert files_of(folder) == (2 if large else 0)


def test_of_nothing_there_is_nothing(folder):
    assert by_rows(0, 10, lambda cut: torch.ones(20, 2)[:0][cut]).shape == (0, 2)
    with pytest.raises(ValueError, match="nothing to stack"):
        stacked([], 3)
