import pytest
import torch

from reflectsep.errors import CaptureError
from reflectsep.io.response import read_response


def test_reads_rows_with_heading_and_comments(tmp_path):
    (tmp_path / "r.csv").write_text("# camera 3\nvalue,radiance\n0, 0\n0.5,0.2 # half\n\n1.0,1e0\n")
    value, radiance = read_response(tmp_path / "r.csv")
    assert value.dtype == torch.float64
    assert value.tolist() == [0, 0.5, 1]
    assert radiance.tolist() == [0, 0.2, 1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 rows"),
        ("0,0\n", "1 rows"),
        ("value,radiance\nvalue,radiance\n", "line 2: found 'value,radiance', expected two numbers"),
        ("0,0\n0.5\n", "line 2"),
        ("0,0\n0.5,1,2\n", "line 2"),
        ("0,0\n0.5,nan\n", "line 2"),
        ("0,0\n0,1\n", "line 2: '0,1' does not rise"),
        ("0,0\n0.5,0\n", "line 2: '0.5,0' does not rise"),
        ("0,1\n0.5,0.5\n", "line 2: .* does not rise"),
        ("0,0\n255,1\n", "line 2: value 255, expected 0 to 1"),
    ],
)
def test_errors(tmp_path, text, message):
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(CaptureError, match=rf"r\.csv: {message}"):
        read_response(tmp_path / "r.csv")


def test_missing_and_binary(tmp_path):
    with pytest.raises(CaptureError, match="no such file"):
        read_response(tmp_path / "r.csv")
    (tmp_path / "r.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CaptureError, match="cannot be read as text"):
        read_response(tmp_path / "r.csv")
