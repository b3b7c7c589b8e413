"""glTF files: the attributes of KHR_gaussian_splatting, levels with MSFT_lod, and read back."""

import base64
import json
import os
import struct
import sys
from dataclasses import replace

import numpy as np
import pytest

from tests.training.splats.level_files import UP, assert_equal, camera, flod, read
from tests.training.splats.test_formats import random_splats
from tests.training.splats.test_spz import spz, spz4
from training.editing.export import FileOptions, export_finest_level, export_levels
from training.errors import LodgsError
from training.splats import gltf, gltf_reader
from training.splats.formats import find_format
from training.splats.gaussians import SH_C0
from training.splats.gltf import write_compressed_glb
from training.splats.levels import Bundle, Level
from training.splats.portable_levels import PortableLevels

PREFIX = "KHR_gaussian_splatting:"


def read_parts(path):
    """Return the JSON document and the binary data of a file, read by the glTF 2.0 specification."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON") and length % 4 == 0
    document = json.loads(data[20 : 20 + length])
    size, kind = struct.unpack("<I4s", data[20 + length : 28 + length])
    assert kind == b"BIN\0" and size == document["buffers"][0]["byteLength"] == len(data) - 28 - length
    return document, data[28 + length :]


def assembled(document, data):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def accessor(document, data, index):
    entry = document["accessors"][index]
    view = document["bufferViews"][entry["bufferView"]]
    assert view["byteOffset"] % 4 == 0
    kind, size = {5126: ("<f4", 4), 5121: ("u1", 1)}[entry["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]]
    assert view["byteLength"] == entry["count"] * width * size
    return np.frombuffer(data, kind, entry["count"] * width, view["byteOffset"]).reshape(-1, width)


def test_attributes_follow_the_extension(tmp_path):
    bundle = flod()
    export_levels(tmp_path / "a.glb", bundle)
    document, data = read_parts(tmp_path / "a.glb")
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting", "MSFT_lod"]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0 and primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display",
    }  # fmt: skip
    columns = {name: accessor(document, data, index) for name, index in primitive["attributes"].items()}
    splats = bundle.levels[2].splats
    assert np.array_equal(columns["POSITION"], splats.means)
    entry = document["accessors"][primitive["attributes"]["POSITION"]]
    assert entry["min"] == splats.means.min(0).tolist() and entry["max"] == splats.means.max(0).tolist()
    np.testing.assert_allclose(columns[f"{PREFIX}SCALE"], np.exp(splats.log_scales), rtol=1e-6)
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    np.testing.assert_allclose(columns[f"{PREFIX}ROTATION"], unit[:, [1, 2, 3, 0]], atol=1e-6)
    alphas = 1 / (1 + np.exp(-splats.opacity_logits))
    np.testing.assert_allclose(columns[f"{PREFIX}OPACITY"][:, 0], alphas, atol=1e-6)
    names = [f"{PREFIX}SH_DEGREE_{n}_COEF_{i}" for n in range(4) for i in range(2 * n + 1)]
    assert np.array_equal(np.stack([columns[name] for name in names], 1), splats.sh)
    color = (255 * np.column_stack([0.5 + SH_C0 * splats.sh[:, 0], alphas])).clip(0, 255)
    assert np.abs(columns["COLOR_0"] - color).max() <= 0.51


def test_levels_are_nodes_by_coverage(tmp_path):
    export_levels(tmp_path / "a.glb", flod())
    document, _ = read_parts(tmp_path / "a.glb")
    nodes = document["nodes"]
    assert nodes[0]["extensions"]["MSFT_lod"]["ids"] == [1, 2]
    assert [node["name"] for node in nodes[:3]] == ["Level 3", "Level 2", "Level 1"]
    shares = nodes[0]["extras"]["MSFT_screencoverage"]
    assert len(shares) == 3 and 1 > shares[0] > shares[1] > shares[2] == 0
    assert document["scenes"][0]["nodes"] == [0, 3, 4, 5]  # coarser levels only replace the finest
    up = np.array(nodes[0]["matrix"]).reshape(4, 4).T[:3, :3] @ np.linalg.inv(UP) @ [0, 0, 1]
    np.testing.assert_allclose(up, [0, 1, 0], atol=1e-12)


def test_cameras_match_the_views(tmp_path):
    export_levels(tmp_path / "a.glb", flod())
    document, _ = read_parts(tmp_path / "a.glb")
    node = next(node for node in document["nodes"] if "camera" in node)
    lens = document["cameras"][node["camera"]]["perspective"]
    point = np.array([0.4, 0.2, 1.5, 1])
    splats_to_world = np.array(document["nodes"][0]["matrix"]).reshape(4, 4).T
    x, y, z, _ = np.linalg.inv(np.array(node["matrix"]).reshape(4, 4).T) @ splats_to_world @ point
    view = camera()
    right, down, ahead, _ = view.world_to_camera @ point
    np.testing.assert_allclose([x, y, z], [right, -down, -ahead], atol=1e-12)
    focal = 1 / np.tan(lens["yfov"] / 2)
    np.testing.assert_allclose(focal * 240, 520)
    np.testing.assert_allclose(focal / lens["aspectRatio"] * 320, 500)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_levels_round_trip(tmp_path, degree):
    bundle = flod(degree)
    export_levels(tmp_path / "a.glb", bundle)
    reread = read(tmp_path / "a.glb")
    assert (reread.method, reread.rule, len(reread.levels)) == ("flod", "bands", 3)
    for level, original in zip(reread.levels, bundle.levels, strict=True):
        assert level.facts == original.facts
        assert_equal(level.splats, original.splats)


@pytest.mark.parametrize("foreign", [False, True])
def test_undrawable_splats_are_dropped_with_a_warning(tmp_path, foreign):
    bundle = flod(1)
    export_levels(tmp_path / "a.glb", bundle)
    document, data = read_parts(tmp_path / "a.glb")
    finest = document["nodes"][document["scenes"][0]["nodes"][0]]
    positions = document["meshes"][finest["mesh"]]["primitives"][0]["attributes"]["POSITION"]
    view = document["bufferViews"][document["accessors"][positions]["bufferView"]]
    data = bytearray(data)
    struct.pack_into("<f", data, view["byteOffset"] + 12 * 7, float("nan"))  # x of splat 7
    if foreign:
        document["scenes"][0].pop("extras")
    (tmp_path / "b.glb").write_bytes(assembled(document, bytes(data)))
    warnings = []
    reread = read(tmp_path / "b.glb", warnings.append)
    assert [len(level.splats) for level in reread.levels] == [20, 40, 59]
    expected = np.delete(bundle.levels[2].splats.opacity_logits, 7)
    np.testing.assert_allclose(reread.levels[2].splats.opacity_logits, expected, atol=2e-3)
    assert len(warnings) == 1 and warnings[0].startswith("1 splats of ")


def test_original_place_survives(tmp_path):
    origin = [448_250.0, 5_411_900.0, 300.0]
    bundle = flod(origin=origin)
    export_levels(tmp_path / "a.glb", bundle, FileOptions(original_place=True))
    reread = read(tmp_path / "a.glb")
    expected = bundle.levels[2].splats.means.astype(np.float64) + origin
    np.testing.assert_allclose(reread.levels[2].splats.means + reread.origin, expected, atol=1e-4)
    document, data = read_parts(tmp_path / "a.glb")
    document["scenes"][0].pop("extras")  # as from another program
    (tmp_path / "b.glb").write_bytes(assembled(document, data))
    reread = read(tmp_path / "b.glb")
    assert reread.origin.any() and not reread.rule and len(reread.levels) == 3
    actual = (reread.levels[2].splats.means + reread.origin) @ reread.up_rotation.T
    np.testing.assert_allclose(actual, expected @ np.array(UP).T, atol=1e-3)


def test_one_level_has_no_nodes_for_levels(tmp_path):
    splats = random_splats(50, 1)
    export_finest_level(tmp_path / "a.glb", Bundle("", [Level(4, splats)]))
    document, _ = read_parts(tmp_path / "a.glb")
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"] and len(document["nodes"]) == 1
    assert_equal(read(tmp_path / "a.glb").levels[0].splats, splats)
    kind = find_format(tmp_path / "a.glb")
    assert abs((tmp_path / "a.glb").stat().st_size - kind.size(50, 1)) < 4000


def test_empty_levels_are_left_out(tmp_path):
    bundle = flod()
    empty = bundle.levels[1].splats.select(slice(0, 0))
    bundle.levels[1] = replace(bundle.levels[1], splats=empty)
    export_levels(tmp_path / "a.glb", bundle)
    assert [level.number for level in read(tmp_path / "a.glb").levels] == [1, 3]
    bundle.levels = [replace(level, splats=empty) for level in bundle.levels]
    with pytest.raises(LodgsError, match="no splats"):
        export_levels(tmp_path / "a.glb", bundle)


def rewrite(path, change):
    """Change the document of a file as another program, which keeps no description of LODGS."""
    document, data = read_parts(path)
    scene = document["scenes"][0]
    scene.pop("extras", None)
    change(document["nodes"], scene["nodes"])
    path.write_bytes(assembled(document, data))
    return read(path)


def test_objects_with_and_without_levels_are_joined(tmp_path):
    """Copy an object with three levels twice: with two of its levels, and with the finest one."""
    bundle = flod()
    export_levels(tmp_path / "a.glb", bundle)

    def copy(nodes, roots):
        parent = next(node for node in nodes if 0 in node.get("children", [])) if 0 not in roots else None
        two, one = ({**nodes[0], "extensions": {}} for _ in "ab")
        two["extensions"] = {"MSFT_lod": {"ids": nodes[0]["extensions"]["MSFT_lod"]["ids"][:1]}}
        (roots if parent is None else parent["children"]).extend([len(nodes), len(nodes) + 1])
        nodes += [two, one]

    coarse, middle, fine = (len(level.splats) for level in bundle.levels)
    joined = rewrite(tmp_path / "a.glb", copy)
    counts = [len(level.splats) for level in joined.levels]
    assert counts == [coarse + middle + fine, 2 * middle + fine, 3 * fine]


def export_mesh(path, count=1):
    """Export splats at (1, 2, 3), and return the document and its binary data."""
    splats = random_splats(count)
    splats.means[:] = (1, 2, 3)
    splats.sh = splats.sh[:, :1]
    export_levels(path, Bundle("", [Level(1, splats)]))
    return read_parts(path)


def centers(document, data, path):
    """Write a document with splats around their node, and return the splats' means in glTF's axes."""
    path.write_bytes(assembled(document, data))
    bundle = read(path)
    (level,) = bundle.levels
    return level.splats.means.astype(np.float64) + bundle.meta.get("origin", 0)


def test_nodes_may_share_a_mesh(tmp_path):
    document, data = export_mesh(tmp_path / "a.glb", 1000)
    document["scenes"] = [{"nodes": [0, 1, 2, 3]}]
    document["nodes"] = [{"mesh": 0, "translation": [x, 0, 0]} for x in range(4)]
    means = centers(document, data, tmp_path / "a.glb")
    np.testing.assert_allclose(means, [[1 + x, 2, 3] for x in range(4) for _ in range(1000)], rtol=1e-5)


def test_instances_of_a_mesh(tmp_path):
    """Instances are turned and scaled before the node moves them."""
    document, data = export_mesh(tmp_path / "a.glb")
    count, half = 3, 0.5**0.5
    columns = {
        "TRANSLATION": np.float32([[0, 0, 0], [10, 0, 0], [0, 0, 0]]),
        "ROTATION": np.float32([[0, 0, 0, 1], [0, 0, 0, 1], [0, 0, half, half]]),  # a quarter around z
        "SCALE": np.float32([[1, 1, 1], [2, 2, 2], [1, 1, 1]]),
    }
    attributes = {}
    for name, values in columns.items():
        view = {"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes}
        kind = f"VEC{values.shape[1]}"
        attributes[name] = len(document["accessors"])
        entry = {"bufferView": len(document["bufferViews"]), "componentType": 5126, "type": kind}
        document["accessors"].append({**entry, "count": count})
        document["bufferViews"].append(view)
        data += values.tobytes()
    document["buffers"][0]["byteLength"] = len(data)
    instancing = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    document["scenes"] = [{"nodes": [0]}]
    document["nodes"] = [{"mesh": 0, "translation": [0, 100, 0], "extensions": instancing}]
    means = centers(document, data, tmp_path / "a.glb")
    np.testing.assert_allclose(means, [[1, 102, 3], [12, 104, 6], [-2, 101, 3]], rtol=1e-5)


def test_too_many_instances_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(gltf_reader, "_MEMORY", 0)
    monkeypatch.setattr(gltf_reader, "_RATIO", 1)
    document, data = export_mesh(tmp_path / "a.glb")
    document["nodes"] = [{"mesh": 0} for _ in range(1000)]
    del document["scenes"]
    with pytest.raises(LodgsError, match=r"too short for .* splats in instances"):
        centers(document, data, tmp_path / "a.glb")


@pytest.mark.parametrize("antialias", [True, False])
def test_antialiased_spz_stays_antialiased(tmp_path, antialias):
    bundle = Bundle("", [Level(1, random_splats(9))], meta={"antialias": antialias})
    write_compressed_glb(tmp_path / "a.glb", PortableLevels(bundle))
    assert rewrite(tmp_path / "a.glb", lambda nodes, roots: None).antialias == antialias


def test_quantised_attributes_of_other_programs(tmp_path):
    """Normalised integers, an interleaved buffer, and a node with rotation and scale."""
    fields = [
        ("mean", "<f4", 3), ("quat", "<i2", 4), ("scale", "<f4", 3), ("alpha", "u1"), ("pad", "u1", 3),
        ("sh", "<f4", 3),
    ]  # fmt: skip
    row = np.zeros(2, fields)
    row["mean"], row["quat"], row["scale"], row["alpha"] = (1, 2, 3), (0, 0, 0, 32767), 0.5, 51
    data = row.tobytes()
    kinds = {"POSITION": ("mean", "VEC3", 5126), f"{PREFIX}ROTATION": ("quat", "VEC4", 5122),
             f"{PREFIX}SCALE": ("scale", "VEC3", 5126), f"{PREFIX}OPACITY": ("alpha", "SCALAR", 5121),
             f"{PREFIX}SH_DEGREE_0_COEF_0": ("sh", "VEC3", 5126)}  # fmt: skip
    document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "buffers": [{"byteLength": len(data)}],
        "nodes": [{"children": [1], "scale": [2, 2, 2]},
                  {"mesh": 0, "rotation": [0, 0, 0.5**0.5, 0.5**0.5], "translation": [1, 0, 0]}],
        "bufferViews": [{"buffer": 0, "byteLength": len(data), "byteStride": row.itemsize}],
        "accessors": [{"bufferView": 0, "byteOffset": row.dtype.fields[field][1], "componentType": component,
                       "type": kind, "count": 2, "normalized": component in (5121, 5122)}
                      for field, kind, component in kinds.values()],
        "meshes": [{"primitives": [{"mode": 0, "attributes": dict(zip(kinds, range(5), strict=True)),
                                    "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse"}}}]}],
    }  # fmt: skip
    (tmp_path / "a.glb").write_bytes(assembled(document, data))
    (level,) = read(tmp_path / "a.glb").levels
    np.testing.assert_allclose(level.splats.means[0], [-2, 2, 6], atol=1e-6)  # 2 · ((-2, 1, 3) + (1, 0, 0))
    np.testing.assert_allclose(np.exp(level.splats.log_scales), 1, rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-level.splats.opacity_logits)), 0.2, rtol=1e-5)
    np.testing.assert_allclose(np.abs(level.splats.quats[0]), [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-6)


def edited(tmp_path, change, name="b.glb"):
    """Write one level, change its document as another program, and return the splats that are read again."""
    bundle = flod(1)
    del bundle.levels[:-1]
    export_levels(tmp_path / "a.glb", bundle)
    document, data = read_parts(tmp_path / "a.glb")
    (primitive,) = document["meshes"][0]["primitives"]
    data = change(document, primitive, data) or data
    if name.endswith(".gltf"):
        (tmp_path / name).write_text(json.dumps(document))
    else:
        (tmp_path / name).write_bytes(assembled(document, data))
    return read(tmp_path / "a.glb").levels[-1].splats, read(tmp_path / name).levels[-1].splats


def first_draft(document, primitive, data):
    names = {f"{PREFIX}ROTATION": "_ROTATION", f"{PREFIX}SCALE": "_SCALE"}
    primitive["attributes"] = {
        names.get(key, key): value
        for key, value in primitive["attributes"].items()
        if key in (*names, "POSITION", "COLOR_0")
    }
    primitive["extensions"]["KHR_gaussian_splatting"] = {"quantizedPositionScale": 2.0}


def second_draft(document, primitive, data):
    for name in ("OPACITY", "SH_DEGREE_0_COEF_0"):
        del primitive["attributes"][PREFIX + name]


@pytest.mark.parametrize(("draft", "scale", "degree"), [(first_draft, 2, 0), (second_draft, 1, 1)])
def test_drafts_have_base_colour_and_opacity_in_color_0(tmp_path, draft, scale, degree):
    """KHR_gaussian_splatting of 2024 (README of CesiumGS/glTF 8417ae0) and of 2025."""
    expected, splats = edited(tmp_path, draft)
    assert splats.sh_degree == degree
    np.testing.assert_allclose(np.abs(splats.means).max(), scale * np.abs(expected.means).max(), rtol=1e-5)
    colors, stored = (0.5 + SH_C0 * s.sh[:, 0] for s in (splats, expected))
    np.testing.assert_allclose(colors, stored.clip(0, 1), atol=0.5 / 255 + 1e-6)
    alphas, stored = (1 / (1 + np.exp(-s.opacity_logits)) for s in (splats, expected))
    np.testing.assert_allclose(alphas, stored, atol=0.5 / 255 + 1e-6)


def test_logarithmic_scales_and_logits_of_other_programs(tmp_path):
    """playcanvas/splat-transform#267, javagl/JSplat#8."""

    def change(document, primitive, data):
        data = bytearray(data)
        for name, convert in (("SCALE", np.log), ("OPACITY", lambda alphas: np.log(alphas / (1 - alphas)))):
            accessor = document["accessors"][primitive["attributes"][PREFIX + name]]
            view = document["bufferViews"][accessor["bufferView"]]
            begin = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
            count = accessor["count"] * (3 if name == "SCALE" else 1)
            values = np.frombuffer(data, np.float32, count, begin)
            values[:] = convert(values)
        return bytes(data)

    expected, splats = edited(tmp_path, change)
    assert_equal(splats, expected)


def test_document_without_scenes(tmp_path):
    """The specification allows it. Coarser levels are no roots."""
    export_levels(tmp_path / "a.glb", flod())
    document, data = read_parts(tmp_path / "a.glb")
    document["scenes"][0].pop("extras")  # as from another program
    (tmp_path / "b.glb").write_bytes(assembled(document, data))
    del document["scenes"], document["scene"]
    (tmp_path / "c.glb").write_bytes(assembled(document, data))
    expected, actual = (read(tmp_path / name).levels for name in ("b.glb", "c.glb"))
    assert len(actual) == len(expected) == 3
    for level, original in zip(actual, expected, strict=True):
        assert_equal(level.splats, original.splats)


@pytest.mark.parametrize(
    "name", ["KHR_gaussian_splatting_compression_spz", "KHR_spz_gaussian_splats_compression"]
)
def test_spz_in_drafts(tmp_path, name):
    bundle = flod(1)
    del bundle.levels[:-1]
    write_compressed_glb(tmp_path / "a.glb", PortableLevels(bundle))
    document, data = read_parts(tmp_path / "a.glb")
    extensions = document["meshes"][0]["primitives"][0]["extensions"]
    if name.startswith("KHR_spz"):
        del extensions["KHR_gaussian_splatting"]
        extensions[name] = {"bufferView": 0}
    else:
        extensions["KHR_gaussian_splatting"]["extensions"] = {name: {"bufferView": 0}}
    (tmp_path / "b.glb").write_bytes(assembled(document, data))
    first, second = (read(tmp_path / file).levels[-1].splats for file in ("a.glb", "b.glb"))
    np.testing.assert_array_equal(first.means, second.means)


@pytest.mark.parametrize("version", [3, 4, 5])
def test_newer_versions_of_spz(tmp_path, version):
    """Programs put the SPZ that they write by default into glTF."""
    data = spz4(30, 1, version) if version > 3 else spz(30, 1, bytes(30 * (20 + 9)))
    data += bytes(-len(data) % 4)
    bundle = flod(1)
    del bundle.levels[:-1]
    write_compressed_glb(tmp_path / "a.glb", PortableLevels(bundle))
    document, _ = read_parts(tmp_path / "a.glb")
    document["bufferViews"][0]["byteLength"] = document["buffers"][0]["byteLength"] = len(data)
    del document["scenes"][0]["extras"]
    (tmp_path / "a.glb").write_bytes(assembled(document, data))
    if version == 5:
        with pytest.raises(LodgsError, match=r"a\.glb: SPZ version 5 is not supported"):
            read(tmp_path / "a.glb")
    else:
        splats = read(tmp_path / "a.glb").levels[-1].splats
        assert len(splats) == 30 and splats.sh_degree == 1


@pytest.mark.parametrize("uri", ["data:application/octet-stream;base64,", "parts/the%20data.bin"])
def test_gltf_with_its_data_as_text_or_in_another_file(tmp_path, uri):
    def change(document, primitive, data):
        is_text = uri.startswith("data:")
        document["buffers"][0]["uri"] = uri + base64.b64encode(data).decode() * is_text
        (tmp_path / "parts").mkdir()
        (tmp_path / "parts" / "the data.bin").write_bytes(data)

    expected, splats = edited(tmp_path, change, "b.gltf")
    assert_equal(splats, expected)


def test_linear_colours_become_display_coded(tmp_path):
    """IEC 61966-2-1 for the base colour, and its slope for the others."""

    def change(document, primitive, data):
        primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] = "lin_rec709_display"

    expected, splats = edited(tmp_path, change)
    linear = 0.5 + SH_C0 * expected.sh[:, 0].astype(np.float64)
    visible = linear > 0.01
    coded = 0.5 + SH_C0 * splats.sh[:, 0]
    np.testing.assert_allclose(coded[visible], 1.055 * linear[visible] ** (1 / 2.4) - 0.055, atol=1e-5)
    step = 1e-4
    slope = ((linear[visible] + step) ** (1 / 2.4) - linear[visible] ** (1 / 2.4)) * 1.055 / step
    ratio = (splats.sh[:, 1] / expected.sh[:, 1])[visible]
    np.testing.assert_allclose(ratio, slope, rtol=5e-3)


def test_splats_of_several_degrees_keep_the_highest(tmp_path):
    def change(document, primitive, data):
        lower = {k: v for k, v in primitive["attributes"].items() if "SH_DEGREE_1" not in k}
        document["meshes"][0]["primitives"].append(primitive | {"attributes": lower})

    expected, splats = edited(tmp_path, change)
    count = len(expected)
    assert splats.sh_degree == expected.sh_degree and splats.sh[:count, 1:].any()
    np.testing.assert_array_equal(splats.sh[count:, 1:], 0)


def change_buffer(document):
    document["buffers"][0]["uri"] = "../secret.bin"


def change_compression(document):
    extension = document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    extension["extensions"] = {"KHR_gaussian_splatting_compression_other": {"bufferView": 0}}


def change_view(document):
    document["bufferViews"][0] |= {"buffer": 1, "extensions": {"EXT_meshopt_compression": {"buffer": 0}}}


def change_count(document):
    for entry in document["accessors"]:
        entry["count"] = 2**40


def change_node(document):
    document["nodes"][0]["children"] = [0]


def change_index(document):
    document["nodes"][0]["mesh"] = -1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (change_buffer, "refers to other files"),
        (change_compression, "needs? the extension KHR_gaussian_splatting_compression_other"),
        (change_view, "need the extension EXT_meshopt_compression"),
        (change_count, "exceeds its data"),
        (change_node, "occurs twice"),
        (change_index, "-1 is not a count"),
    ],
)
def test_unusable_files_raise_one_sentence(tmp_path, change, reason):
    export_levels(tmp_path / "a.glb", flod())
    document, data = read_parts(tmp_path / "a.glb")
    change(document)
    (tmp_path / "b.glb").write_bytes(assembled(document, data))
    with pytest.raises(LodgsError, match=reason):
        read(tmp_path / "b.glb")


def test_files_above_4_gib_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(gltf, "_MAX_BYTES", 1000)
    with pytest.raises(LodgsError, match="exceed the 4 GiB"):
        export_levels(tmp_path / "a.glb", flod())
    assert not list(tmp_path.iterdir())


def test_compressed_level_is_read_within_the_steps_of_spz(tmp_path):
    bundle = flod(2)
    del bundle.levels[:-1]
    write_compressed_glb(tmp_path / "a.glb", PortableLevels(bundle))
    document, _ = read_parts(tmp_path / "a.glb")
    extension = "KHR_gaussian_splatting_compression_spz_2"
    assert document["extensionsRequired"] == ["KHR_gaussian_splatting", extension]
    reread = read(tmp_path / "a.glb").levels[-1].splats
    expected = bundle.levels[-1].splats
    np.testing.assert_allclose(reread.means, expected.means, atol=1e-5)
    np.testing.assert_allclose(reread.log_scales, expected.log_scales, atol=0.5 / 16 + 1e-5)
    assert reread.sh.shape == expected.sh.shape


def test_highly_compressed_level_is_rejected(tmp_path):
    bundle = flod(0)
    del bundle.levels[:-1]
    bundle.levels[0] = Level(1, bundle.levels[0].splats.select(np.zeros(20_000, int)))
    write_compressed_glb(tmp_path / "a.glb", PortableLevels(bundle))
    with pytest.raises(LodgsError, match="20,000 splats"):
        read(tmp_path / "a.glb")


def test_transforms_beyond_the_largest_coordinate_are_refused(tmp_path):
    export_levels(tmp_path / "a.glb", flod())
    document, data = read_parts(tmp_path / "a.glb")
    for values in ({"translation": [1e13, 0, 0]}, {"scale": [1e200] * 3}, {"rotation": [1e200] * 4}):
        node = {key: value for key, value in document["nodes"][0].items() if key != "matrix"} | values
        nodes = [node, *document["nodes"][1:]]
        (tmp_path / "b.glb").write_bytes(assembled(document | {"nodes": nodes}, data))
        with pytest.raises(LodgsError, match=r"a transform has numbers above 1e\+12"):
            read(tmp_path / "b.glb")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps mapped files")
def test_file_that_another_program_truncates_is_reported(tmp_path, monkeypatch):
    export_levels(tmp_path / "a.glb", flod())
    view = gltf_reader._GlbReader._view

    def view_of_truncated(reader, index):
        os.truncate(tmp_path / "a.glb", 4096)
        return view(reader, index)

    monkeypatch.setattr(gltf_reader._GlbReader, "_view", view_of_truncated)
    with pytest.raises(LodgsError, match="another program has truncated it"):
        read(tmp_path / "a.glb")


def test_levels_of_several_degrees_return_with_the_highest(tmp_path):
    levels = [Level(number, random_splats(9, degree)) for number, degree in ((1, 1), (2, 3))]
    export_levels(tmp_path / "a.glb", Bundle("", levels))
    for level, original in zip(read(tmp_path / "a.glb").levels, levels, strict=True):
        assert_equal(level.splats, original.splats.padded(3))
    with pytest.raises(LodgsError, match="Cannot write SH degree 4 as glTF"):
        export_levels(tmp_path / "b.glb", Bundle("", [Level(1, random_splats(9, 4)), *levels[1:]]))
