"""SOG files and streamed levels, decoded as their specification says."""

import io
import json
import shutil
import zipfile

import numpy as np
import pytest
from PIL import Image

from training.errors import LodgsError
from training.splats.formats import open_as_ply
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply
from training.splats.sog import decode_sog, encode_sog, make_palette, read_sog, write_sog
from training.splats.streamed_levels import (
    LEAF_SPLATS,
    STREAMED_FILE,
    read_streamed_levels,
    write_streamed_levels,
)


def random_splats(count: int, degree: int = 0, seed: int = 0, extent: float = 1.0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        (extent * rng.normal(size=(count, 3))).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.uniform(-6, -2, (count, 3)).astype(np.float32),
        rng.normal(size=count).astype(np.float32),
        rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def pixels(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")).reshape(-1, 4)


def test_values_are_stored_as_specified():
    """Worked by hand from the specification of version 2."""
    e = float(np.e)
    splats = Splats(
        np.float32([[0, 0, 0], [e - 1, 1 - e, 0]]),
        np.float32([[1, 0, 0, 0], [0, 0, -2, 0]]),
        np.float32([[-3, -3, -3], [-1, -1, -1]]),
        np.float32([0, np.inf]),
        np.float32([[[0.25] * 3], [[0.5] * 3]]),
    )
    files = encode_sog(splats)
    meta = json.loads(files["meta.json"])
    assert (meta["version"], meta["count"]) == (2, 2)
    np.testing.assert_allclose(meta["means"]["mins"], [0, -1, 0], atol=1e-6)  # sign(x) log(1 + |x|)
    np.testing.assert_allclose(meta["means"]["maxs"], [1, 0, 0], atol=1e-6)
    low, high = pixels(files["means_l.webp"]), pixels(files["means_u.webp"])
    codes = low[:2, :3].astype(int) + 256 * high[:2, :3].astype(int)
    assert codes.tolist() == [[0, 65535, 0], [65535, 0, 0]]
    quats = pixels(files["quats.webp"])[:2]
    assert quats[:, 3].tolist() == [252, 254]  # w and y are the largest
    np.testing.assert_allclose(quats[:, :3], 127.5, atol=0.51)
    scales, colors = (np.array(meta[name]["codebook"]) for name in ("scales", "sh0"))
    np.testing.assert_allclose(scales[pixels(files["scales.webp"])[:2, 0]], [-3, -1], atol=1e-6)
    assert (np.diff(scales) >= 0).all() and len(scales) == 256
    values = pixels(files["sh0.webp"])[:2]
    np.testing.assert_allclose(colors[values[:, 0]], [0.25, 0.5], atol=1e-6)
    assert values[:, 3].tolist() == [128, 255]


def write_first_version(path):
    """Write two splats as SOG of version 1, whose layout is that of PlayCanvas' engine 2.8."""

    def image(rows, width=4):
        pixels = np.zeros((4, width, 4), np.uint8)
        pixels.reshape(-1, 4)[: len(rows)] = rows
        target = io.BytesIO()
        Image.fromarray(pixels).save(target, "WEBP", lossless=True, exact=True)
        return target.getvalue()

    palette = np.zeros((64 * 15, 4), np.uint8)
    palette[15:18, 0] = 51, 102, 255  # the first coefficients of set 1, red
    files = {
        "means_l.webp": image([[0, 255, 0, 255], [255, 0, 0, 255]]),
        "means_u.webp": image([[0, 255, 0, 255], [255, 0, 0, 255]]),
        "scales.webp": image([[0, 0, 0, 255], [255, 51, 0, 255]]),
        "quats.webp": image([[128, 128, 128, 252], [128, 128, 128, 254]]),
        "sh0.webp": image([[0, 0, 0, 0], [255, 51, 0, 255]]),
        "shN_centroids.webp": image(palette, 64 * 15),
        "shN_labels.webp": image([[0, 0, 0, 255], [1, 0, 0, 255]]),
    }
    meta = {
        "means": {
            "shape": [2, 3], "mins": [-1, 0, 0], "maxs": [1, 2, 0], "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"shape": [2, 3], "mins": [-5, -5, -4], "maxs": [0, 0, 0], "files": ["scales.webp"]},
        "quats": {"shape": [2, 4], "encoding": "quaternion_packed", "files": ["quats.webp"]},
        "sh0": {"shape": [2, 1, 4], "mins": [-1, -1, 0, -2], "maxs": [1, 1, 0, 3], "files": ["sh0.webp"]},
        "shN": {"shape": [2, 15], "mins": -1, "maxs": 1, "files": ["shN_centroids.webp", "shN_labels.webp"]},
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in ({"meta.json": json.dumps(meta).encode()} | files).items():
            archive.writestr(name, data)


def test_first_version_is_read(tmp_path):
    """Values are fractions of ranges, worked by hand; means are stored as sign(x) log(1 + |x|)."""
    write_first_version(tmp_path / "a.sog")
    splats, _ = read_sog(tmp_path / "a.sog")
    e = float(np.e)
    np.testing.assert_allclose(splats.means, [[1 - e, e**2 - 1, 0], [e - 1, 0, 0]], rtol=1e-6)
    np.testing.assert_allclose(splats.log_scales, [[-5, -5, -4], [0, -4, -4]], rtol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, [-2, 3], rtol=1e-6)
    np.testing.assert_allclose(splats.sh[:, 0], [[-1, -1, 0], [1, -0.6, 0]], atol=1e-6)
    assert splats.sh.shape == (2, 16, 3)
    np.testing.assert_allclose(splats.sh[0, 1:], -1)
    np.testing.assert_allclose(splats.sh[1, 1:5, 0], [-0.6, -0.2, 1, -1], atol=1e-6)
    np.testing.assert_allclose(np.abs(splats.quats), [[1, 0, 0, 0], [0, 0, 1, 0]], atol=0.01)


def test_splat_transform_reads_the_same_first_version(tmp_path, splat_transform):
    write_first_version(tmp_path / "a.sog")
    splat_transform(tmp_path / "a.sog", tmp_path / "a.ply")
    theirs, (ours, _) = read_ply(tmp_path / "a.ply"), read_sog(tmp_path / "a.sog")
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-5, err_msg=name)


def test_unknown_version_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("meta.json", '{"version": 3, "count": 1}')
    with pytest.raises(
        LodgsError, match=r"a\.sog: it is SOG of version 3\. Export it as version 2 or as PLY"
    ):
        read_sog(tmp_path / "a.sog")


def test_null_in_a_codebook_continues_its_steps():
    """splat-transform wrote null for -infinity; PlayCanvas' engine replaces it since pull request 8056."""
    files = encode_sog(random_splats(500))
    meta = json.loads(files["meta.json"])
    table = meta["scales"]["codebook"]
    expected = table[1] + (table[1] - table[255]) / 255
    table[0] = None
    codes = pixels(files["scales.webp"])[:500, :3]
    decoded, _ = decode_sog((files | {"meta.json": json.dumps(meta).encode()}).__getitem__)
    assert (codes == 0).any()
    np.testing.assert_allclose(decoded.log_scales[codes == 0], expected, rtol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splats_round_trip(tmp_path, degree):
    splats = random_splats(900, degree)
    write_sog(tmp_path / "a.sog", splats, {})
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        decoded, _ = decode_sog(archive.read)
    distances = np.linalg.norm(decoded.means[:, None] - splats.means[None], axis=2)
    splats = splats.select(distances.argmin(axis=1))
    assert np.abs(decoded.means - splats.means).max() < 5e-4
    assert np.abs(decoded.log_scales - splats.log_scales).max() < 0.02
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    assert np.abs((unit * decoded.quats).sum(axis=1)).min() > np.cos(np.radians(0.6))
    sigmoid = [1 / (1 + np.exp(-x.opacity_logits)) for x in (splats, decoded)]
    assert np.abs(sigmoid[0] - sigmoid[1]).max() <= 0.51 / 255
    assert np.sqrt(np.mean((decoded.sh - splats.sh) ** 2)) < 0.02


def test_equal_splats_give_equal_files(tmp_path):
    write_sog(tmp_path / "a.sog", random_splats(20), {})
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_palette_is_near_the_sets():
    """Two thousand copies of 800 sets need no more than the 1,024 sets of a palette."""
    rng = np.random.default_rng(0)
    sets = rng.normal(size=(800, 9)).astype(np.float32)
    rows = rng.integers(0, 800, 2000)
    palette, labels = make_palette(sets[rows])
    assert len(palette) <= 1024
    error = np.sqrt(np.mean((palette[labels] - sets[rows]) ** 2))
    assert error < 0.25  # 1 without a palette


def test_palette_of_many_small_groups_keeps_its_limit():
    """63 sets far from the others are groups of their own; all labels are rows of the palette."""
    sets = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    rows = np.linspace(0, 4999, 64).astype(int)[:63]
    sets[rows] += 1000 * np.arange(1, 64)[:, None]
    palette, labels = make_palette(sets)
    assert len(palette) <= 4096 and labels.max() < len(palette)
    np.testing.assert_allclose(palette[labels[rows]], sets[rows], atol=1e-2)


@pytest.mark.parametrize(
    ("splats", "message"), [(random_splats(9, 4), "degree 4"), (random_splats(0), "no splats")]
)
def test_splats_that_sog_cannot_store_are_refused(tmp_path, splats, message):
    with pytest.raises(LodgsError, match=message):
        write_sog(tmp_path / "a.sog", splats, {})
    assert not list(tmp_path.iterdir())


def leaves(node: dict):
    for child in node.get("children", ()):
        yield from leaves(child)
    if "lods" in node:
        yield node


def test_streamed_levels_hold_every_splat_once(tmp_path):
    levels = [Level(1, random_splats(9_000, 0, 1)), Level(2, random_splats(30_000, 1, 2))]
    levels[1].splats.means[:40] += 30  # the surroundings
    write_streamed_levels(tmp_path / "web", Bundle("flod", levels))
    meta = json.loads((tmp_path / "web" / STREAMED_FILE).read_text("utf-8"))
    assert meta["lodLevels"] == 2 and meta["count"] == sum(meta["counts"])

    def read(name: str) -> Splats:
        folder = (tmp_path / "web" / name).parent
        return decode_sog(lambda file: (folder / file).read_bytes())[0]

    files = [read(name) for name in meta["filenames"]]
    parts: dict[str, list[np.ndarray]] = {"0": [], "1": []}
    for leaf in leaves(meta["tree"]):
        assert sum(entry["count"] for entry in leaf["lods"].values()) <= LEAF_SPLATS
        for lod, entry in leaf["lods"].items():
            rows = slice(entry["offset"], entry["offset"] + entry["count"])
            means = files[entry["file"]].means[rows]
            assert (means >= np.array(leaf["bound"]["min"]) - 1e-3).all()
            assert (means <= np.array(leaf["bound"]["max"]) + 1e-3).all()
            parts[lod].append(means)
    far = read(meta["environment"])
    assert far.sh_degree == files[0].sh_degree == files[-1].sh_degree == 1  # of all levels
    finest = np.concatenate([*parts["0"], far.means])
    assert sorted(map(len, (finest, np.concatenate(parts["1"])))) == [9_000, 30_000]
    order = [np.lexsort(np.round(means, 2).T) for means in (finest, levels[1].splats.means)]
    np.testing.assert_allclose(
        np.sort(finest[order[0]], axis=0), np.sort(levels[1].splats.means[order[1]], axis=0), atol=2e-3
    )


def test_levels_are_read_with_the_surroundings(tmp_path, monkeypatch):
    """Many leaves, whose tree is deeper than other JSON may be."""
    monkeypatch.setattr("training.splats.streamed_levels.LEAF_SPLATS", 8)
    levels = [Level(1, random_splats(400, 0, 1)), Level(2, random_splats(900, 1, 2))]
    levels[1].splats.means[:40] += 30
    write_streamed_levels(tmp_path / "web", Bundle("flod", levels))
    read_streamed_levels(tmp_path / "web" / STREAMED_FILE, tmp_path / "read")
    for lod, count in ((0, 900), (1, 440)):
        splats = read_ply(tmp_path / "read" / f"lod{lod}.ply")
        assert len(splats) == count and (splats.means > 20).all(axis=1).sum() == 40
    assert not (tmp_path / "read" / "lod2.ply").exists()


def test_levels_with_one_archive_per_file(tmp_path):
    """gsbox writes its files so."""
    splats = random_splats(300)
    write_streamed_levels(tmp_path / "web", Bundle("", [Level(1, splats)]))
    meta = json.loads((tmp_path / "web" / STREAMED_FILE).read_text("utf-8"))
    (name,) = meta["filenames"]
    folder = (tmp_path / "web" / name).parent
    with zipfile.ZipFile(tmp_path / "web" / "0_0.sog", "w") as archive:
        for file in folder.iterdir():
            archive.write(file, file.name)
    shutil.rmtree(folder)
    (tmp_path / "web" / STREAMED_FILE).write_text(json.dumps(meta | {"filenames": ["0_0.sog"]}), "utf-8")
    read_streamed_levels(tmp_path / "web" / STREAMED_FILE, tmp_path / "read")
    assert len(read_ply(tmp_path / "read" / "lod0.ply")) == 300


def test_levels_without_splats_are_omitted(tmp_path):
    write_streamed_levels(tmp_path / "web", Bundle("", [Level(1, random_splats(9))]))
    meta = json.loads((tmp_path / "web" / STREAMED_FILE).read_text("utf-8"))
    meta["tree"]["lods"]["2"] = {"file": 0, "offset": 0, "count": 0}
    (tmp_path / "web" / STREAMED_FILE).write_text(json.dumps(meta | {"lodLevels": 3}), "utf-8")
    read_streamed_levels(tmp_path / "web" / STREAMED_FILE, tmp_path / "read")
    assert [path.name for path in (tmp_path / "read").iterdir()] == ["lod0.ply"]


def test_antialiased_splats_stay_antialiased(tmp_path):
    splats, meta = random_splats(9), {"antialias": True}
    write_sog(tmp_path / "a.sog", splats, meta)
    assert read_sog(tmp_path / "a.sog")[1] == meta
    write_sog(tmp_path / "b.sog", splats, {})
    assert read_sog(tmp_path / "b.sog")[1] == {}
    write_streamed_levels(tmp_path / "web", Bundle("", [Level(1, splats)], meta=meta))
    with open_as_ply(tmp_path / "web") as folder:
        assert read_folder(folder).antialias


def test_images_may_be_png(tmp_path):
    """The specification permits all formats with 8-bit RGBA."""
    splats = random_splats(300, 1)
    files = encode_sog(splats)
    expected, _ = decode_sog(files.__getitem__)
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("meta.json", files.pop("meta.json").replace(b".webp", b".png"))
        for name, data in files.items():
            png = io.BytesIO()
            Image.open(io.BytesIO(data)).save(png, "PNG")
            archive.writestr(name.replace(".webp", ".png"), png.getvalue())
    actual, _ = read_sog(tmp_path / "a.sog")
    np.testing.assert_array_equal(actual.means, expected.means)
    np.testing.assert_array_equal(actual.sh, expected.sh)


@pytest.mark.parametrize("name", ["garden", "garden/meta.json"])
def test_files_in_a_folder(tmp_path, name):
    """PlayCanvas writes SOG as one file or as the files of a folder."""
    splats = random_splats(300, 1)
    write_sog(tmp_path / "a.sog", splats, {})
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "garden")
    expected, _ = read_sog(tmp_path / "a.sog")
    with open_as_ply(tmp_path / name) as path:
        assert path.name == "garden.ply"
        np.testing.assert_array_equal(read_ply(path).means, expected.means)


@pytest.mark.parametrize("file", ["../secret.webp", "/etc/secret.webp", "C:/secret.webp", "sub/a.webp"])
def test_files_outside_the_folder_are_refused(tmp_path, file):
    write_sog(tmp_path / "a.sog", random_splats(9), {})
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "garden")
    meta = json.loads((tmp_path / "garden" / "meta.json").read_text())
    meta["quats"]["files"] = [file]
    (tmp_path / "garden" / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(LodgsError, match=r"Cannot read .*meta\.json"):
        read_sog(tmp_path / "garden" / "meta.json")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("filenames", ["../secret/meta.json"]),
        ("filenames", ["C:/meta.json"]),
        ("environment", "/etc/meta.json"),
        ("filenames", []),
        ("tree", {"lods": {"0": {"file": 0, "offset": 3, "count": 7}}}),
        ("tree", {"lods": {"0": {"file": 0, "offset": 0, "count": 2**40}}}),
        ("tree", {"children": [{"lods": {"0": {"file": 0, "offset": 0, "count": 9}}}] * 2}),
        ("tree", []),
        ("tree", {"lods": {"-1": {"file": 0, "offset": 0, "count": 9}}}),
        ("lodLevels", 10**9),
        ("version", 2),
    ],
)
def test_hostile_main_files_are_refused(tmp_path, name, value):
    write_streamed_levels(tmp_path / "web", Bundle("", [Level(1, random_splats(9))]))
    meta = json.loads((tmp_path / "web" / STREAMED_FILE).read_text("utf-8"))
    (tmp_path / "web" / STREAMED_FILE).write_text(json.dumps(meta | {name: value}), "utf-8")
    with pytest.raises(LodgsError, match="Cannot read"):
        read_streamed_levels(tmp_path / "web" / STREAMED_FILE, tmp_path / "read")


def test_errors_of_leaves_grow_with_the_level(tmp_path, monkeypatch):
    """The format asks for one number per level in each leaf, no smaller than that of a finer level."""
    monkeypatch.setattr("training.splats.streamed_levels.LEAF_SPLATS", 200)
    levels = [Level(number, random_splats(300, 0, number)) for number in (1, 2, 3)]
    seen = []

    def measure(splats, bounds):
        seen.append(sum(map(len, splats.values())))
        low, high = bounds
        assert all((part.means >= low).all() and (part.means <= high).all() for part in splats.values())
        return {lod: (0.0, 0.5, 0.25)[lod] for lod in splats}

    write_streamed_levels(tmp_path / "web", Bundle("flod", levels), measure)
    meta = json.loads((tmp_path / "web" / STREAMED_FILE).read_text("utf-8"))
    assert meta["lodErrors"] is True and sum(seen) == meta["count"]
    assert {tuple(leaf["errors"]) for leaf in leaves(meta["tree"])} == {(0.0, 0.5, 0.5)}


def test_degree_4_is_refused(tmp_path):
    with pytest.raises(LodgsError, match="degree 4"):
        write_streamed_levels(tmp_path / "web", Bundle("", [Level(1, random_splats(9, 4))]))
    assert not list(tmp_path.iterdir())


def test_file_is_not_replaced_by_levels(tmp_path):
    (tmp_path / "web").write_text("thesis")
    with pytest.raises(LodgsError, match="not a folder"):
        write_streamed_levels(tmp_path / "web", Bundle("", [Level(1, random_splats(9))]))
    assert (tmp_path / "web").read_text() == "thesis"


def test_infinite_scales_and_opacities_are_limited(tmp_path):
    splats = random_splats(50)
    splats.log_scales[::5, 1], splats.opacity_logits[::7] = -np.inf, np.inf
    decoded, _ = decode_sog(encode_sog(splats).__getitem__)
    finite = np.isfinite(splats.log_scales)
    assert np.abs(decoded.log_scales - splats.log_scales)[finite].max() < 0.2
    assert (decoded.log_scales[~finite] < -15).all() and np.isfinite(decoded.opacity_logits).all()
