"""Bundles and folders of levels, read by plyfile and by copies of strict viewers."""

import hashlib
import json
import re

import numpy as np
import pytest
from plyfile import PlyData

from training.cli.info import describe
from training.errors import LodgsError
from training.splats.bundle import read_bundle, read_header, write_bundle
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply, write_ply

from . import viewers

COUNTS = (3, 20, 5000)
S_MIN = (0.1 + 0.2, 1 / 3, 0.0)
META = {
    "method": "flod",
    "camera_center": [1 / 3, -2.0, 1e-300],
    "focal_px": 601.23456789,
    "seed": 7,
    "note": "packed_ end_header f_rest_0 element chunk é \n",
}


@pytest.fixture
def bundle(make_splats):
    """Three levels with a float and a byte column; the middle one has a third extra."""
    levels = []
    for number, (count, s_min) in enumerate(zip(COUNTS, S_MIN, strict=True), 1):
        extras = {"decay": np.arange(count, dtype="f4") + number, "label": np.arange(count).astype("u1")}
        if number == 2:
            extras["middle_only"] = np.arange(count, dtype="f8") / 3
        levels.append(Level(number, make_splats(count, 3, **extras), {"s_min": s_min}))
    return Bundle("flod", levels, "bands", {}, {"gamma": 1.5}, meta=META)


def assert_equal(a: Bundle, b: Bundle, same):
    for name in ("method", "rule", "facts", "controls", "cumulative", "meta"):
        assert getattr(a, name) == getattr(b, name), name
    assert [(x.number, x.facts) for x in a.levels] == [(x.number, x.facts) for x in b.levels]
    assert all(same(x.splats, y.splats) for x, y in zip(a.levels, b.levels, strict=True))


@pytest.mark.parametrize("cumulative", [False, True])
def test_header_describes_the_bundle(tmp_path, bundle, cumulative, monkeypatch):
    bundle.cumulative = cumulative
    write_bundle(tmp_path / "b.ply", bundle)
    monkeypatch.setattr("training.splats.bundle.splats_from_rows", None)  # no splat is read
    head = read_header(tmp_path / "b.ply")
    assert (head.method, head.rule, head.controls, head.meta) == ("flod", "bands", {"gamma": 1.5}, META)
    assert [(level.number, level.facts) for level in head.levels] == [
        (n, {"s_min": s_min}) for n, s_min in enumerate(S_MIN, 1)
    ]
    assert head.cumulative is cumulative
    write_ply(tmp_path / "plain.ply", bundle.levels[0].splats)
    plain = read_header(tmp_path / "plain.ply")
    assert (plain.method, plain.rule, [level.number for level in plain.levels]) == ("", "", [1])
    (tmp_path / "b.ply").write_bytes((tmp_path / "b.ply").read_bytes().replace(b'"level":2', b'"level":[]'))
    with pytest.raises(LodgsError, match="is inconsistent"):
        read_header(tmp_path / "b.ply")


@pytest.mark.parametrize("order", ["finest_first", "stream"])
@pytest.mark.parametrize("cumulative", [False, True])
def test_bundle_round_trips_bit_for_bit(tmp_path, bundle, same, order, cumulative):
    bundle.cumulative = cumulative
    write_bundle(tmp_path / "b.ply", bundle, order)
    assert_equal(bundle, read_bundle(tmp_path / "b.ply"), same)


def test_unusual_bits_round_trip(tmp_path, bundle):
    """Negative zeros, denormals, NaN payloads and infinities keep their bits."""
    bits = np.array([0x80000000, 0x00000001, 0x7FC01234, 0xFF800000], np.uint32)
    finest = bundle.levels[2].splats
    finest.means.reshape(-1)[:2] = bits[:2].view("f4")
    finest.opacity_logits[0] = finest.log_scales[1, 2] = -np.inf  # transparent, flat
    finest.extras["odd"] = np.resize(bits, len(finest)).view("f4")
    write_bundle(tmp_path / "b.ply", bundle)
    back = read_bundle(tmp_path / "b.ply").levels[2].splats
    for name in ("means", "opacity_logits", "log_scales"):
        assert getattr(back, name).tobytes() == getattr(finest, name).tobytes()
    assert back.extras["odd"].tobytes() == finest.extras["odd"].tobytes()


def test_plyfile_reads_the_finest_level_first(tmp_path, bundle):
    write_bundle(tmp_path / "b.ply", bundle)
    data = PlyData.read(str(tmp_path / "b.ply"))
    assert [(element.name, element.count) for element in data.elements] == [
        ("vertex", 5000),
        ("lod_1_vertex", 20),
        ("lod_2_vertex", 3),
        ("lod_extra_0", 5000),
        ("lod_extra_1", 20),
        ("lod_extra_2", 3),
    ]
    finest = bundle.levels[2].splats
    np.testing.assert_array_equal(data["vertex"]["y"], finest.means[:, 1])
    np.testing.assert_array_equal(data["vertex"]["f_rest_15"], finest.sh[:, 1, 1])
    np.testing.assert_array_equal(data["lod_2_vertex"]["scale_2"], bundle.levels[0].splats.log_scales[:, 2])
    np.testing.assert_array_equal(data["lod_extra_1"]["middle_only"], np.arange(20) / 3)
    assert data["lod_extra_0"].data.dtype == np.dtype([("decay", "<f4"), ("label", "u1")])
    assert data.obj_info == [] and data.byte_order == "<"


def test_offsets_locate_each_level(tmp_path, bundle):
    """Read as a streaming reader does: comments, then a byte range."""
    write_bundle(tmp_path / "b.ply", bundle, "stream")
    header, data = (tmp_path / "b.ply").read_bytes().split(b"end_header\n", 1)
    facts = [json.loads(text) for text in re.findall(rb"comment lodsplat (.*)\n", header)]
    levels = [fact for fact in facts if "level" in fact]
    assert [fact["level"] for fact in levels] == [1, 2, 3] and levels[0]["element"] == "vertex"
    for fact, level in zip(levels, bundle.levels, strict=True):
        rows = np.frombuffer(data, "<f4", fact["count"] * 62, fact["offset"]).reshape(-1, 62)
        np.testing.assert_array_equal(rows[:, :3], level.splats.means)


def test_cumulative_rows_are_coarse_to_fine_in_one_vertex(tmp_path, bundle):
    bundle.cumulative = True
    write_bundle(tmp_path / "b.ply", bundle)
    rows = PlyData.read(str(tmp_path / "b.ply"))["vertex"].data
    expected = np.concatenate([level.splats.means[:, 0] for level in bundle.levels])
    np.testing.assert_array_equal(rows["x"], expected)


@pytest.mark.parametrize("cumulative", [False, True])
def test_strict_viewers_open_bundles(tmp_path, bundle, cumulative):
    bundle.cumulative = cumulative
    write_bundle(tmp_path / "b.ply", bundle)
    data = (tmp_path / "b.ply").read_bytes()
    offset, count, columns = viewers.strict(data)["vertex"]
    assert (offset, count, len(columns)) == (0, 5023 if cumulative else 5000, 62)
    first = bundle.levels[0 if cumulative else 2].splats
    rows = viewers.fixed_record(data, degree=3)
    assert len(rows) == count
    np.testing.assert_array_equal(rows[:3, :3], first.means[:3])
    np.testing.assert_array_equal(rows[:3, -4:], first.quats[:3])
    header = data[: data.index(b"end_header\n")]
    for word in (b"obj_info", b"packed_", b"element chunk", b"list ", b"\r", b"\n\n"):
        assert word not in header
    assert not any(b"f_rest_" in line for line in header.split(b"\n") if line.startswith(b"comment"))


def test_readers_that_sum_all_properties_need_a_plain_file(tmp_path, bundle):
    """This known limit of bundles is the reason to export plain PLYs."""
    write_bundle(tmp_path / "b.ply", bundle)
    with pytest.raises(ValueError, match="out of bounds"):
        viewers.read_all_properties((tmp_path / "b.ply").read_bytes())
    finest = bundle.levels[2].splats
    finest.extras = {}
    write_ply(tmp_path / "plain.ply", finest)
    rows = viewers.read_all_properties((tmp_path / "plain.ply").read_bytes())
    np.testing.assert_array_equal(rows[:, -4:], finest.quats)


def test_header_of_five_full_levels_is_below_10_kb(tmp_path, make_splats):
    levels = [
        Level(i, make_splats(2, 3, decay=np.zeros(2, "f4")), {"s_min": 0.123456789012345678 / i})
        for i in range(1, 6)
    ]
    meta = META | {f"parameter_{i}": i / 7 for i in range(12)}
    write_bundle(tmp_path / "b.ply", Bundle("flod", levels, "bands", meta=meta))
    assert (tmp_path / "b.ply").read_bytes().index(b"end_header\n") < 10 * 1024


def test_meta_too_long_for_a_header_raises_one_sentence(tmp_path, bundle):
    bundle.meta = {"centres": list(range(5000))}
    with pytest.raises(LodgsError, match="bytes of header"):
        write_bundle(tmp_path / "b.ply", bundle)
    assert list(tmp_path.iterdir()) == []


def test_antialias_flag_round_trips(tmp_path, bundle):
    for meta, flag in (
        (META, False),
        (META | {"antialias": False}, False),
        (META | {"antialias": True}, True),
    ):
        bundle.meta = meta
        write_bundle(tmp_path / "b.ply", bundle)
        back = read_bundle(tmp_path / "b.ply")
        assert back.antialias is read_header(tmp_path / "b.ply").antialias is flag and back.meta == meta


def test_numpy_numbers_in_meta_become_plain_numbers(tmp_path, bundle):
    bundle.meta = {"center": np.array([1.5, 2.5]), "focal_px": np.float32(0.1), "n": np.int64(3)}
    write_bundle(tmp_path / "b.ply", bundle)
    assert read_bundle(tmp_path / "b.ply").meta == {
        "center": [1.5, 2.5],
        "focal_px": float(np.float32(0.1)),
        "n": 3,
    }


def test_plain_ply_reads_as_one_level(tmp_path, make_splats, same):
    splats = make_splats(5, 4, temperature=np.arange(5, dtype="i2"))
    write_ply(tmp_path / "a.ply", splats)
    back = read_bundle(tmp_path / "a.ply")
    assert (back.method, back.meta, [x.number for x in back.levels]) == ("", {}, [1])
    assert same(splats, back.levels[0].splats)


def test_read_ply_reads_the_finest_level(tmp_path, bundle):
    write_bundle(tmp_path / "b.ply", bundle)
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply").means, bundle.levels[2].splats.means)


def test_foreign_elements_and_comments_are_ignored(tmp_path, bundle, same):
    write_bundle(tmp_path / "b.ply", bundle)
    data = (tmp_path / "b.ply").read_bytes()
    data = data.replace(b"comment lodsplat", b"comment made by lodsplat and more {\ncomment lodsplat", 1)
    data = data.replace(b"end_header\n", b"element camera 2\nproperty double fov\nend_header\n", 1) + bytes(
        16
    )
    (tmp_path / "c.ply").write_bytes(data)
    assert_equal(bundle, read_bundle(tmp_path / "c.ply"), same)


@pytest.mark.parametrize("missing", [1, 5000])
def test_truncated_bundle_reports_missing_bytes(tmp_path, bundle, missing):
    write_bundle(tmp_path / "b.ply", bundle)
    data = (tmp_path / "b.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(data[:-missing])
    with pytest.raises(LodgsError, match=f"truncated, {missing} of {len(data)} bytes are missing"):
        read_bundle(tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'lodsplat {"v":2', b'lodsplat {"v":2,'),
        (b'lodsplat {"v":2,', b"lodsplat {"),
        (b'lodsplat {"v":2,', b'lodsplat {"v":99,'),
        (b'"element":"lod_2_vertex"', b'"element":"lod_9_vertex"'),
        (b'"level":2,"lod":1,"count":20', b'"level":2,"lod":1,"count":21'),
        (b'"extras":"lod_extra_1"', b'"extras":"lod_extra_2"'),
        (b'"count":3,', b""),
        (b'{"level":1', b'[{"level":1'),
        (b'{"level":1,', b'{"level":"one",'),
        (b'"meta":{', b'"meta":{"up_rotation":[0,0,1],'),
        (b'"meta":{', b'"meta":{"antialias":"no",'),
        (b'"gamma":1.5', b'"gamma":"far"'),
        (b'"rule":"bands"', b'"rule":null'),
        (b'"cumulative":false', b'"cumulative":"false"'),
        (b'"count":20,', b'"count":19,'),
        (b'"level":2,', b'"level":"2",'),
        (b'"level":2,', b'"level":2.5,'),
        (b'"level":2,', b'"level":1e400,'),
        (b'"level":1,', b'"level":0,'),
        (b'"level":3,', b'"level":1099511627776,'),
        (b'"meta":{', b'"meta":[],"was":{'),
        (b'"camera_center":[', b'"camera_center":[NaN,0,0],"was":['),
        (b'"camera_center":[', b'"camera_center":["1","2","3"],"was":['),
        (b'"facts":{},', b'"facts":' + b"[" * 5000 + b","),
        (b'"facts":{},', b'"facts":{"a":1' + b"0" * 400 + b"},"),
        (b'"facts":{},', b'"facts":{"a":1e31},'),
        (b'"facts":{},', b'"facts":{"a":true},'),
        (b'"facts":{},', b'"facts":["a"],'),
        (b'"v":2,', b'"v":2.0,'),
        (b'"v":2,', b'"v":[2],'),
        (b'"v":2,"method":"flod"', b'"v":2,"method":["flod"]'),
        (b'"camera_center":[', b'"camera_center":[1e13,0,0],"was":['),
        (b'"count":20,', b'"count":-20,'),
        (b'"count":20,', b'"count":20.0,'),
    ],
)
def test_inconsistent_header_raises_one_sentence(tmp_path, bundle, old, new):
    write_bundle(tmp_path / "b.ply", bundle)
    data = (tmp_path / "b.ply").read_bytes()
    assert data.count(old) == 1
    (tmp_path / "b.ply").write_bytes(data.replace(old, new))
    with pytest.raises(
        LodgsError,
        match=r"b\.ply(: .*is inconsistent| is not valid|: it is a bundle of the newer version 99)",
    ):
        read_bundle(tmp_path / "b.ply")


def test_corrupt_headers_never_raise_other_exceptions(tmp_path, make_splats):
    """Change, remove and insert bytes anywhere in the header: it is read, or an error names the file."""
    finer = make_splats(9, 1, id=np.arange(9, dtype="u1"))
    levels = [Level(1, make_splats(3, 1), {"s_min": 0.5}), Level(2, finer)]
    path = tmp_path / "b.ply"
    write_bundle(path, Bundle("flod", levels, "bands", {}, {"gamma": 1}, meta={"gamma": 1}))
    intact = path.read_bytes()
    end = intact.index(b"end_header\n") + len(b"end_header\n")
    random = np.random.default_rng(5)
    refused = 0
    for _ in range(400):
        data = bytearray(intact)
        at, removed = random.integers(end), random.choice([0, 1, 40])
        data[at : at + removed] = random.choice(
            [b"", b"\n", b"\r", b"0", b"-", b"{", b"\xff", b"element q 3\n"]
        )
        path.write_bytes(data)
        try:
            describe(path)
        except LodgsError as error:
            assert "b.ply" in str(error)
            refused += 1
    assert 200 < refused < 400


def test_levels_of_different_degrees_are_refused(tmp_path, make_splats):
    levels = [Level(1, make_splats(2, 0)), Level(2, make_splats(2, 3))]
    with pytest.raises(LodgsError, match="different degrees"):
        write_bundle(tmp_path / "b.ply", Bundle("flod", levels))
    assert list(tmp_path.iterdir()) == []


def test_folder_round_trips_and_matches_its_manifest(tmp_path, bundle, same):
    write_folder(tmp_path / "f", bundle)
    assert sorted(x.name for x in (tmp_path / "f").iterdir()) == [
        "lod0.ply",
        "lod1.ply",
        "lod2.ply",
        "manifest.json",
    ]
    manifest = json.loads((tmp_path / "f" / "manifest.json").read_text())
    for lod, (fact, level) in enumerate(zip(manifest["levels"], reversed(bundle.levels), strict=True)):
        file = tmp_path / "f" / f"lod{lod}.ply"
        data = file.read_bytes()
        assert (fact["file"], fact["level"], fact["count"]) == (file.name, level.number, len(level.splats))
        assert (fact["bytes"], fact["sha256"]) == (len(data), hashlib.sha256(data).hexdigest())
        assert fact["bounds"] == [level.splats.means.min(0).tolist(), level.splats.means.max(0).tolist()]
    # All files have the same columns, so the extra of one level is only in the bundle.
    del bundle.levels[1].splats.extras["middle_only"]
    assert_equal(bundle, read_folder(tmp_path / "f"), same)


def test_replaced_folder_loses_old_levels_and_keeps_foreign_files(tmp_path, bundle):
    write_folder(tmp_path, bundle)
    foreign = ["lod9.txt", "lod.ply", "my_lod7.ply", "lod2_old.ply", "scene.ply"]
    for name in foreign:
        (tmp_path / name).write_text("mine")
    write_folder(tmp_path, Bundle("flod", bundle.levels[1:], meta=bundle.meta))
    assert sorted(x.name for x in tmp_path.iterdir()) == sorted(
        [*foreign, "lod0.ply", "lod1.ply", "manifest.json"]
    )
    assert [level.number for level in read_folder(tmp_path).levels] == [2, 3]


def test_files_beside_a_first_export_stay(tmp_path, bundle):
    names = ["lod7.ply", "tables.ply"]
    for name in names:
        (tmp_path / name).write_text("mine")
    write_folder(tmp_path, bundle)
    assert [(tmp_path / name).read_text() for name in names] == ["mine", "mine"]


def test_failed_export_leaves_the_folder_unchanged(tmp_path, bundle, monkeypatch):
    write_folder(tmp_path, bundle)
    original = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    bundle.levels[1].splats.extras["two words"] = np.zeros(20)  # not a PLY name
    for level in bundle.levels:
        level.splats.extras["two words"] = np.zeros(len(level.splats), "f4")
    with pytest.raises(LodgsError, match="two words"):
        write_folder(tmp_path, Bundle("flod", bundle.levels[1:]))
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == original


def test_level_of_another_export_is_reported(tmp_path, bundle, make_splats):
    write_folder(tmp_path, bundle)
    write_ply(tmp_path / "lod1.ply", make_splats(19))
    with pytest.raises(LodgsError, match="level 2 should have 20 splats"):
        read_folder(tmp_path)


def test_elements_are_not_reused_and_levels_are_limited(tmp_path, bundle, make_splats):
    """Header lines of a few bytes must not multiply the memory of an element."""
    bundle.tables = {"a": {"x": np.zeros(7, "f4")}, "b": {"x": np.zeros(7, "f4")}}
    write_bundle(tmp_path / "b.ply", bundle)
    data = (tmp_path / "b.ply").read_bytes()
    for old, new in (
        (b'"table":"b","element":"lod_b"', b'"table":"a","element":"lod_a"'),
        (b'"table":"b","element":"lod_b"', b'"table":"2_vertex","element":"lod_2_vertex"'),
        (b'"table":"b"', b'"table":"c"'),
        (b'"extras":"lod_extra_2"', b'"extras":"lod_2_vertex"'),
    ):
        assert old in data
        (tmp_path / "c.ply").write_bytes(data.replace(old, new))
        with pytest.raises(LodgsError, match=r"c\.ply: .*is inconsistent"):
            read_bundle(tmp_path / "c.ply")
    levels = [Level(number, make_splats(0, 0)) for number in range(1, 66)]
    for number in range(65):
        write_ply(tmp_path / "many" / f"lod{number}.ply", levels[0].splats)
    with pytest.raises(LodgsError, match="65 levels"):
        read_folder(tmp_path / "many")


def test_bounds_ignore_non_numeric_means(tmp_path, bundle):
    bundle.levels[0].splats.means[0, 1] = np.nan
    expected = bundle.levels[0].splats.means[1:]
    write_folder(tmp_path, bundle)
    bounds = json.loads((tmp_path / "manifest.json").read_text())["levels"][2]["bounds"]
    assert bounds == [expected.min(0).tolist(), expected.max(0).tolist()]


def test_cumulative_folder_holds_complete_scenes_and_round_trips(tmp_path, bundle, same):
    bundle.cumulative = True
    for level in bundle.levels:
        level.splats.extras.pop("middle_only", None)
    write_folder(tmp_path, bundle)
    assert [len(read_ply(tmp_path / f"lod{lod}.ply")) for lod in (2, 1, 0)] == [3, 23, 5023]
    expected = Splats.concatenated([level.splats for level in bundle.levels])
    np.testing.assert_array_equal(read_ply(tmp_path / "lod0.ply").sh, expected.sh)
    assert_equal(bundle, read_folder(tmp_path), same)
    write_ply(tmp_path / "lod1.ply", expected)
    with pytest.raises(LodgsError, match="level 2 should have 23 splats"):
        read_folder(tmp_path)


def assert_tables_equal(expected, actual):
    assert list(actual) == list(expected)
    for name, table in expected.items():
        assert list(actual[name]) == list(table)
        for column, values in table.items():
            np.testing.assert_array_equal(actual[name][column], values)
            assert actual[name][column].dtype == values.dtype


def test_tables_round_trip_in_bundle_and_folder(tmp_path, bundle, same):
    rng = np.random.default_rng(0)
    bundle.tables = {
        "chunks": {"x": rng.normal(size=7).astype("f4"), "splats": np.arange(7, dtype="u4")},
        "empty": {"x": np.zeros(0, "f4")},
    }
    write_bundle(tmp_path / "b.ply", bundle)
    restored = read_bundle(tmp_path / "b.ply")
    assert_equal(bundle, restored, same)
    assert_tables_equal(bundle.tables, restored.tables)
    assert "table chunks: 7 rows of x, splats" in describe(tmp_path / "b.ply")
    for level in bundle.levels:
        level.splats.extras.pop("middle_only", None)
    write_folder(tmp_path / "f", bundle)
    restored = read_folder(tmp_path / "f")
    assert_equal(bundle, restored, same)
    assert_tables_equal(bundle.tables, restored.tables)
    assert "table chunks: 7 rows of x, splats" in describe(tmp_path / "f")
    bundle.tables = {}
    write_folder(tmp_path / "f", bundle)
    assert not (tmp_path / "f" / "tables.ply").exists() and read_folder(tmp_path / "f").tables == {}


def test_levels_that_add_up_must_have_one_degree(tmp_path, make_splats):
    levels = [Level(number, make_splats(9)) for number in (1, 2)]
    write_folder(tmp_path, Bundle("octree", levels, cumulative=True))
    write_ply(tmp_path / "lod1.ply", make_splats(9, degree=1))
    with pytest.raises(LodgsError, match="levels that add up have different SH degrees"):
        read_folder(tmp_path)


def test_inconsistent_tables_of_a_folder_are_refused(tmp_path, bundle):
    bundle.tables = {"chunks": {"x": np.zeros(3, "f4")}}
    write_folder(tmp_path, bundle)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    for tables in (7, [{"table": "chunks"}], [{"table": "chunks", "element": "vertex"}],
                   [{"table": "more", "element": "lod_more"}], ["chunks"]):  # fmt: skip
        (tmp_path / "manifest.json").write_text(json.dumps(manifest | {"tables": tables}))
        with pytest.raises(LodgsError, match="is inconsistent"):
            read_folder(tmp_path)
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    (tmp_path / "tables.ply").unlink()
    with pytest.raises(LodgsError, match=r"tables\.ply"):
        read_folder(tmp_path)


def test_folder_without_manifest_is_read(tmp_path, make_splats):
    for lod, count in ((0, 50), (2, 5), (10, 1)):
        write_ply(tmp_path / f"tree_lod{lod}.ply", make_splats(count))
    bundle = read_folder(tmp_path)
    assert [(level.number, len(level.splats)) for level in bundle.levels] == [(1, 1), (2, 5), (3, 50)]
    write_ply(tmp_path / "lod0.ply", make_splats(1))
    with pytest.raises(LodgsError, match="2 series"):
        read_folder(tmp_path)


def test_folder_without_levels_is_refused(tmp_path):
    with pytest.raises(LodgsError, match="no series of levels"):
        read_folder(tmp_path)
    for text in ('{"v": 2, "levels": [{}]}', '{"v": 2, "method": "", "meta": {}, "levels": []}', "[]", "{"):
        (tmp_path / "manifest.json").write_text(text)
        with pytest.raises(LodgsError, match=r"manifest\.json(: .*is inconsistent| is not valid)"):
            read_folder(tmp_path)


def test_output_folder_of_a_3dgs_program_has_its_newest_splats(tmp_path, make_splats):
    for number, count in ((7000, 3), (30000, 5), (9999, 4)):
        folder = tmp_path / "point_cloud" / f"iteration_{number}"
        folder.mkdir(parents=True)
        write_ply(folder / "point_cloud.ply", make_splats(count))
    (tmp_path / "point_cloud" / "iteration_last").mkdir()
    assert [len(level.splats) for level in read_folder(tmp_path).levels] == [5]


def test_info_describes_bundle_folder_and_ply(tmp_path, bundle):
    bundle.levels[2].splats.means[:] = [[-1, 2, 3]]
    bundle.levels[1].splats.means[:] = [[-1, 2, 3]]
    bundle.levels[0].splats.means[:] = [[5, 2, 0]]
    write_bundle(tmp_path / "b.ply", bundle)
    text = describe(tmp_path / "b.ply")
    assert "flod, 3 levels" in text and "SH degree 3" in text and "(-1, 2, 0) to (5, 2, 3)" in text
    rows = [line.split() for line in text.splitlines()[4:7]]
    assert [row[:2] for row in rows] == [["1", "3"], ["2", "20"], ["3", "5,000"]]
    # 62 floats, a float and a byte of extras each
    assert rows[2][2] == f"{5000 * (62 * 4 + 5) / 1e6:.2f}" and rows[1][3] == "0.333333"
    assert "focal_px: 601.23456789" in text
    write_folder(tmp_path / "f", bundle)
    assert describe(tmp_path / "f").splitlines()[4].split()[:2] == ["1", "3"]
    write_ply(tmp_path / "plain.ply", bundle.levels[0].splats)
    assert "plain splats, 1 level," in describe(tmp_path / "plain.ply")
