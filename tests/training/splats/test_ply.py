"""Plain PLY files, compared with hand-made bytes and plyfile."""

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from tests.training.splats.test_formats import random_splats
from training.__main__ import main
from training.errors import LodgsError
from training.splats.batches import BATCH_ROWS
from training.splats.file_rows import open_ply
from training.splats.ply import read_elements, read_ply, splats_from_rows, write_ply
from training.splats.spz import write_spz

# Degree 1, two splats; value = splat / 2 + number of the column.
GOLDEN_COLUMNS = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(
        "f_rest_0",
        "f_rest_1",
        "f_rest_2",
        "f_rest_3",
        "f_rest_4",
        "f_rest_5",
        "f_rest_6",
        "f_rest_7",
        "f_rest_8",
    ),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


def golden_values(splat):
    return [0.0 if name in ("nx", "ny", "nz") else 0.5 * splat + i for i, name in enumerate(GOLDEN_COLUMNS)]


def header(kind="binary_little_endian", columns=GOLDEN_COLUMNS, count=2):
    lines = ["ply", f"format {kind} 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in columns), "end_header", ""]).encode()


GOLDEN = header() + struct.pack("<52f", *golden_values(0), *golden_values(1))


def check_golden(splats):
    """Columns 0-2 are means, 6-8 DC, 9-17 rest by channel, 18 opacity, 19-21 scales, 22-25 rotation."""
    for i in range(2):
        o = 0.5 * i
        assert splats.means[i].tolist() == [o, o + 1, o + 2]
        assert splats.sh[i].tolist() == [
            [o + 6, o + 7, o + 8],
            [o + 9, o + 12, o + 15],  # first coefficient of red, green, blue
            [o + 10, o + 13, o + 16],
            [o + 11, o + 14, o + 17],
        ]
        assert splats.opacity_logits[i] == o + 18
        assert splats.log_scales[i].tolist() == [o + 19, o + 20, o + 21]
        assert splats.quats[i].tolist() == [o + 22, o + 23, o + 24, o + 25]


def test_original_layout_is_read(tmp_path):
    (tmp_path / "a.ply").write_bytes(GOLDEN)
    splats = read_ply(tmp_path / "a.ply")
    check_golden(splats)
    assert splats.sh_degree == 1 and splats.extras == {}


def test_written_bytes_match_original_layout(tmp_path):
    (tmp_path / "a.ply").write_bytes(GOLDEN)
    write_ply(tmp_path / "b.ply", read_ply(tmp_path / "a.ply"))
    assert (tmp_path / "b.ply").read_bytes() == GOLDEN


@pytest.mark.parametrize("degree", range(5))
def test_every_degree_round_trips_and_matches_plyfile(tmp_path, make_splats, same, degree):
    count = 5000  # more than one block of rows
    splats = make_splats(count, degree)
    write_ply(tmp_path / "a.ply", splats)
    assert same(splats, read_ply(tmp_path / "a.ply"))

    data = PlyData.read(str(tmp_path / "a.ply"))
    assert [element.name for element in data.elements] == ["vertex"]
    rows = data["vertex"].data
    rest_count = (degree + 1) ** 2 - 1
    assert list(rows.dtype.names) == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(3 * rest_count)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    np.testing.assert_array_equal(rows["z"], splats.means[:, 2])
    np.testing.assert_array_equal(rows["rot_0"], splats.quats[:, 0])
    for i in range(3 * rest_count):  # the reference code: features_rest.transpose(1, 2).flatten(start_dim=1)
        flat = splats.sh[:, 1:].transpose(0, 2, 1).reshape(count, -1)
        np.testing.assert_array_equal(rows[f"f_rest_{i}"], flat[:, i])


def test_big_endian_file_is_read(tmp_path):
    body = struct.pack(">52f", *golden_values(0), *golden_values(1))
    (tmp_path / "a.ply").write_bytes(header("binary_big_endian") + body)
    check_golden(read_ply(tmp_path / "a.ply"))


def test_ascii_file_is_read(tmp_path):
    body = "\n".join(" ".join(map(str, golden_values(i))) for i in range(2)) + "\n"
    (tmp_path / "a.ply").write_bytes(header("ascii") + body.encode())
    check_golden(read_ply(tmp_path / "a.ply"))


def test_windows_line_ends_are_read(tmp_path):
    body = GOLDEN[len(header()) :]
    (tmp_path / "a.ply").write_bytes(header().replace(b"\n", b"\r\n") + body)
    check_golden(read_ply(tmp_path / "a.ply"))


def test_mixed_line_ends_and_blank_lines_of_a_header_are_read(tmp_path):
    head, rows = header(), GOLDEN[len(header()) :]
    mixed = head.replace(b"\n", b"\r\n", 3).replace(b"end_header\n", b"\nend_header\r\n")
    (tmp_path / "a.ply").write_bytes(mixed + rows)
    check_golden(read_ply(tmp_path / "a.ply"))


@pytest.mark.parametrize("nan", ["nan", "-nan(ind)", "1.#QNAN0", "-1.#IND"])
def test_nan_of_windows_programs_is_skipped(tmp_path, nan):
    rows = [list(map(str, golden_values(i))) for i in range(2)]
    rows.append([nan, *rows[0][1:]])
    head = header("ascii").replace(b"element vertex 2", b"element vertex 3")
    (tmp_path / "a.ply").write_bytes(head + "\n".join(map(" ".join, rows)).encode())
    warnings = []
    check_golden(read_ply(tmp_path / "a.ply", warnings.append))
    assert "1 splats" in warnings[0]


def test_reordered_columns_without_normals_before_faces_are_read(tmp_path):
    columns = [name for name in reversed(GOLDEN_COLUMNS) if name not in ("nx", "ny", "nz")]
    rows = np.zeros(2, [(name, "f8") for name in columns])  # doubles are converted
    for name in columns:
        rows[name] = [golden_values(i)[GOLDEN_COLUMNS.index(name)] for i in range(2)]
    faces = np.empty(1, [("vertex_indices", "O")])
    faces["vertex_indices"][0] = np.array([0, 1, 0], "i4")
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, byte_order="<").write(str(tmp_path / "a.ply"))
    check_golden(read_ply(tmp_path / "a.ply"))


def test_unknown_columns_of_every_type_round_trip(tmp_path, make_splats, same):
    kinds = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
    edge = {
        kind: np.array([np.finfo(kind).tiny if kind[0] == "f" else np.iinfo(kind).max, 3, 0], kind)
        for kind in kinds
    }
    splats = make_splats(3, 1, **{f"column_{kind}": column for kind, column in edge.items()})
    write_ply(tmp_path / "a.ply", splats)
    assert same(splats, read_ply(tmp_path / "a.ply"))
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    for kind, column in edge.items():
        assert rows.dtype[f"column_{kind}"] == np.dtype(kind)
        np.testing.assert_array_equal(rows[f"column_{kind}"], column)


def test_nonzero_normals_keep_their_position(tmp_path, make_splats, same):
    splats = make_splats(4, 0, nx=np.arange(4, dtype="f4"), ny=np.zeros(4, "f4"), nz=np.ones(4, "f4"))
    write_ply(tmp_path / "a.ply", splats)
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    assert rows.dtype.names[3:6] == ("nx", "ny", "nz") and rows["nx"].tolist() == [0, 1, 2, 3]
    assert same(splats, read_ply(tmp_path / "a.ply"))


def test_empty_file_round_trips(tmp_path, make_splats):
    write_ply(tmp_path / "a.ply", make_splats(0, 2))
    splats = read_ply(tmp_path / "a.ply")
    assert len(splats) == 0 and splats.sh_degree == 2


def test_selected_splats_are_written_in_order(tmp_path, make_splats):
    splats = make_splats(100, 1, mark=np.arange(100, dtype="u1"))
    write_ply(tmp_path / "a.ply", splats.select(splats.means[:, 0] > 0))
    back = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.extras["mark"], np.flatnonzero(splats.means[:, 0] > 0))


def test_other_formats_name_a_converter(tmp_path):
    (tmp_path / "a.lcc").write_bytes(b"{}")
    with pytest.raises(LodgsError, match=r"a\.lcc: it is not a PLY file") as caught:
        read_ply(tmp_path / "a.lcc")
    assert "splat-transform" in caught.value.remedy


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps mapped files")
def test_file_that_another_program_truncates_is_reported(tmp_path):
    """Reading beyond the end of a mapped file ends the process."""
    write_ply(tmp_path / "a.ply", random_splats(3000))
    rows = open_ply(tmp_path / "a.ply")
    assert len(rows.select(slice(2990, 3000))) == 10
    os.truncate(tmp_path / "a.ply", 5000)
    for read in (rows.select, lambda index: rows.columns(index, ["x"])):
        with pytest.raises(LodgsError, match="another program has truncated it"):
            read(slice(2990, 3000))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps mapped files")
def test_file_that_is_truncated_while_it_is_read_is_reported(tmp_path):
    """A process of its own, because reading beyond the end ends it."""
    write_ply(tmp_path / "a.ply", random_splats(50_000))
    program = """
import os, sys
from training.errors import LodgsError
from training.splats import ply

def batches(count, size):
    for begin in range(0, count, size):
        yield slice(begin, min(begin + size, count))
        os.truncate(sys.argv[1], 1_000_000)

ply.batch_slices = batches
try:
    ply.read_ply(sys.argv[1])
except LodgsError as error:
    print(error)
"""
    command = [sys.executable, "-c", program, tmp_path / "a.ply"]
    process = subprocess.run(command, cwd=Path(__file__).parents[3], capture_output=True, text=True)
    assert "another program has truncated it" in process.stdout, process


@pytest.mark.parametrize("command", ["capture", "compress"])
def test_other_formats_name_the_command_that_converts_them(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    write_spz(Path("a.spz"), random_splats(9), {})
    assert main([command, "a.spz", "--out", "b.ply"]) == 2
    error = "error: Cannot read a.spz: its format is SPZ. Convert it: lodgs edit a.spz --out a.ply\n"
    assert capsys.readouterr().err == error


def test_checkpoints_name_their_program(tmp_path):
    (tmp_path / "ckpt_29999.pt").write_bytes(b"PK\3\4")
    with pytest.raises(LodgsError, match="it is a PyTorch checkpoint") as caught:
        read_ply(tmp_path / "ckpt_29999.pt")
    assert caught.value.remedy == "Export a PLY with the program that wrote it."


@pytest.mark.parametrize("blanks", [b" \n", b"\t\n", b" \r\n"])
def test_header_lines_may_end_with_blanks(tmp_path, blanks):
    lines, body = header(), GOLDEN[len(header()) :]
    (tmp_path / "a.ply").write_bytes(lines.replace(b"\n", blanks) + body)
    (tmp_path / "b.ply").write_bytes(lines + body)
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").means, read_ply(tmp_path / "b.ply").means)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (GOLDEN[:-5], r"a\.ply: it is truncated, 5 of [0-9]+ bytes are missing"),
        (GOLDEN[:100], "truncated, its header has no end"),
        (b"", "it is not a PLY file"),
        (b"PK\x03\x04 something else", r"it is not a PLY file but an archive\. Unpack it"),
        (b"\x1f\x8b\x08", "it is not a PLY file but an archive"),
        (b"\r\n<!DOCTYPE html><p>Sign in", "it is a web page in place of the file"),
        (
            header(columns=["x", "y", "z", "red"]) + bytes(32),
            r"it has no f_dc_0, f_dc_1, f_dc_2, opacity, scale_0",
        ),
        (header(columns=[*GOLDEN_COLUMNS, "f_rest_9"]) + bytes(216), "its 10 f_rest columns"),
        (header(columns=[*GOLDEN_COLUMNS, "x"]) + bytes(216), "header is corrupt"),
        (header().replace(b"float z", b"quad z"), "header is corrupt"),
        (header().replace(b"element vertex", b"element point") + bytes(208), "no element vertex"),
        (header().replace(b"property float x", b"property list uchar int x"), "lists in its vertices"),
        (header("ascii") + b"1 2 3\n", "is corrupt: it is too short"),
        (header("ascii") + b"1 2 3\n" * 26, "is corrupt: .* requires 26 columns"),
        (header("ascii") + b"1 " * 25 + b"one\n" + b"2 " * 26, "is corrupt: could not convert"),
        (header("ascii") + b"1 " * 26 + b"\n" * 60, "is corrupt: 1 of 2 rows of vertex are missing"),
        (header(count="-0") + bytes(208), "header is corrupt: 'element vertex -0'"),
        (header(count="2 2") + bytes(208), "header is corrupt"),
        (header(count="9" * 5000) + bytes(208), "header is corrupt"),
        (header(count=2**60) + bytes(208), "header is corrupt"),
        (header(count=10**14), "truncated, [0-9]+ of [0-9]+ bytes are missing"),
        (header("ascii", count=10**14) + bytes(208), "is corrupt: it is too short"),
        (header(columns=[f"c{i}" for i in range(1001)]), "header is corrupt: it has more than 1,000 columns"),
        (header()[:-11] + b"comment " + b"x" * (1 << 20), "its header exceeds 1,048,576 bytes"),
    ],
)
def test_invalid_file_raises_one_sentence(tmp_path, content, sentence):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(LodgsError, match=sentence) as caught:
        read_ply(tmp_path / "a.ply")
    assert "a.ply" in caught.value.what and caught.value.remedy


FACES = b"element face %d\nproperty list uchar int vertex_indices\n"


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_lists_after_the_vertices_are_not_read(tmp_path, kind):
    """Reading 10^8 faces one by one would take minutes."""
    text = "\n".join(" ".join(map(str, golden_values(i))) for i in range(2)).encode() + b"\n"
    body = text if kind == "ascii" else GOLDEN[len(header()) :]
    head = header(kind)
    faces_last = head.replace(b"end_header", FACES % 10**8 + b"end_header") + body
    (tmp_path / "a.ply").write_bytes(faces_last)
    check_golden(read_ply(tmp_path / "a.ply"))
    empty = head.replace(b"element vertex", FACES % 0 + b"element vertex") + body
    (tmp_path / "a.ply").write_bytes(empty)
    check_golden(read_ply(tmp_path / "a.ply"))
    (tmp_path / "a.ply").write_bytes(
        head.replace(b"element vertex", FACES % 10**8 + b"element vertex") + body
    )
    with pytest.raises(LodgsError, match="lists before its vertices"):
        read_ply(tmp_path / "a.ply")


def test_ascii_elements_with_any_line_ends_are_read(tmp_path):
    text = (
        " ".join(map(str, golden_values(0))) + "\n\n" + " ".join(map(str, golden_values(1))) + "\n7\n8\n9\n"
    )
    further = (
        b"element other 1\nproperty int a\nelement none 3\nelement third 2\nproperty uchar b\nend_header"
    )
    data = header("ascii").replace(b"end_header", further) + text.encode()
    for ends in (b"\n", b"\r\n", b"\r"):
        (tmp_path / "a.ply").write_bytes(data.replace(b"\n", ends))
        elements, _ = read_elements(tmp_path / "a.ply")
        check_golden(splats_from_rows(elements["vertex"], "a"))
        assert (elements["other"]["a"].tolist(), elements["third"]["b"].tolist()) == ([7], [8, 9])
        assert list(elements) == ["vertex", "other", "third"]


def test_comments_outside_ascii_are_ignored(tmp_path):
    (tmp_path / "a.ply").write_bytes(
        GOLDEN.replace(b"end_header", "comment von Jürgen\nend_header".encode(), 1)
    )
    check_golden(read_ply(tmp_path / "a.ply"))


def test_missing_file_raises_one_sentence(tmp_path):
    with pytest.raises(LodgsError, match=r"Cannot read .*none\.ply: No such file"):
        read_ply(tmp_path / "none.ply")


@pytest.mark.parametrize("name,column", [("two words", np.zeros(2, "f4")), ("flag", np.zeros(2, "i8"))])
def test_unsupported_column_raises_one_sentence(tmp_path, make_splats, name, column):
    with pytest.raises(LodgsError, match=f"Cannot write column .{name}"):
        write_ply(tmp_path / "a.ply", make_splats(2, 0, **{name: column}))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind, full", [("u1", 255), ("u2", 65535), ("f4", 1), ("f4", 255), ("i4", 255)])
def test_nerfstudio_splats_with_rgb_colours(tmp_path, kind, full):
    """Colours are relative to 255 as in nerfstudio, to 65535 in 16-bit columns, or to 1 in float ones."""
    names = ["x", "y", "z", "red", "green", "blue", "opacity", *(f"scale_{i}" for i in range(3))]
    kinds = [(name, kind if name in ("red", "green", "blue") else "f4") for name in names]
    rows = np.zeros(2, [*kinds, *((f"rot_{i}", "f4") for i in range(4))])
    red, green, blue = np.array([[1, 0], [0, 0.6], [0.2, 1]]) * full
    rows["red"], rows["green"], rows["blue"], rows["rot_0"] = red, green, blue, 1
    path = tmp_path / "nerfstudio.ply"
    PlyData([PlyElement.describe(rows, "vertex")]).write(path)
    splats = read_ply(path)
    colors = 0.5 + 0.28209479177387814 * splats.sh[:, 0]  # 1 / (2 sqrt(pi)), of degree 0
    assert np.allclose(colors, [[1, 0, 0.2], [0, 0.6, 1]], atol=1e-6)
    assert splats.sh.shape == (2, 1, 3) and not splats.extras


@pytest.mark.skipif(sys.platform != "linux", reason="counts pages in /proc")
def test_read_rows_of_a_mapped_file_leave_memory(tmp_path, make_splats):
    """Mapped pages count as memory of the process, as much as the splats themselves."""
    path = tmp_path / "a.ply"
    write_ply(path, make_splats(4 * BATCH_ROWS, degree=0))
    rows = read_elements(path)[0]["vertex"]

    def resident_bytes():
        lines = iter(Path("/proc/self/smaps").read_text().splitlines())
        sizes = [
            next(text for text in lines if text.startswith("Rss:")) for line in lines if path.name in line
        ]
        return sum(int(text.split()[1]) * 1024 for text in sizes)

    np.asarray(rows["x"]).sum()
    assert resident_bytes() > 0.9 * rows.nbytes
    splats_from_rows(rows, path)
    assert resident_bytes() < 0.3 * rows.nbytes
