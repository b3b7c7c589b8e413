"""A reader written from docs/reference/bundle*.md with only numpy and plyfile selects the same splats."""

import json
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from training.lod.rule import rules
from training.lod.rules.chunks import member_columns
from training.lod.rules.cut import RULE
from training.lod.selection import resolve_controls, select_levels
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level

ROOT = Path(__file__).parents[3]
POSITIONS = ((0, 0, 0), (1.5, -2, 3), (9, 0, 1), (40.25, 3, -8), (-3000, 0, 0))
FOCAL = (60.0, 500.0, 1333.3)
CHOICES = {
    "bands": [{}, {"gamma": 0.3}, {"gamma": 4, "first": 1}, {"first": 2, "last": 4}, {"first": 1, "last": 1}],
    "chunks": [{}, {"distance_scale": 0.3}, {"distance_scale": 7.7, "chunks": 0}, {"fade": 0}],
    "cut": [{}, {"pixels": 0.2}, {"pixels": 3.7}, {"pixels": 41.5}],
    "decay": [{}, {"s_v": 1.7}, {"s_v": 4}, {"at_most": 120}, {"at_most": 17, "s_v": 2}],
    "prefix": [{}, {"at_most": 120}, {"at_most": 1700, "distance_scale": 0.3}, {"distance_scale": 2.5}],
    "octree": [{}, {"offset": 1.7}, {"offset": -3.1}, {"fade": 0}, {"fade": 0, "offset": 0.6}],
}


class Page:
    """A bundle or a folder, read as documented; ``means`` and ``columns`` by level number."""

    def __init__(self, path: Path) -> None:
        if path.is_dir():
            self.head = json.loads((path / "manifest.json").read_text())
            self.meta, lines = self.head["meta"], self.head["levels"]
            rows = {line["level"]: PlyData.read(path / line["file"])["vertex"].data for line in lines}
            extras, self.tables = rows, {}
        else:
            ply = PlyData.read(path)
            elements, begin, rows, extras = {e.name: e.data for e in ply.elements}, {}, {}, {}
            message = [text.removeprefix("lodsplat ") for text in ply["vertex"].comments]
            self.head, *remaining_ones = [json.loads(text) for text in message]
            self.meta = next(line["meta"] for line in remaining_ones if "meta" in line)
            lines = [line for line in remaining_ones if "level" in line]
            for line in lines:
                start = begin.get(line["element"], 0)
                begin[line["element"]] = start + line["count"]
                rows[line["level"]] = elements[line["element"]][start : begin[line["element"]]]
                extras[line["level"]] = elements[line["extras"]] if "extras" in line else None
            self.tables = {
                line["table"]: elements[line["element"]] for line in remaining_ones if "table" in line
            }
        lines.sort(key=lambda line: line["level"])
        self.numbers = [line["level"] for line in lines]
        assert self.head["v"] == 2
        self.rule, self.facts, self.controls = (self.head[key] for key in ("rule", "facts", "controls"))
        self.cumulative = self.head["cumulative"]
        self.level_facts = {line["level"]: line.get("facts", {}) for line in lines}
        self.means, self.opacities, self.columns, original = {}, {}, {}, 0
        for n in self.numbers:
            rows_of_level, extra = rows[n][original:], extras[n]
            self.means[n] = np.stack([rows_of_level[axis] for axis in "xyz"], 1)
            self.opacities[n] = 1 / (1 + np.exp(-rows_of_level["opacity"]))
            names = extra.dtype.names if extra is not None else ()
            self.columns[n] = {name: extra[name][original:] for name in names}
            if path.is_dir() and self.cumulative:  # files of cumulative levels contain coarser levels
                original = len(rows[n])

    def weights(self, position, f: float, arguments: dict) -> dict[int, np.ndarray]:
        """Return w of every splat, by level."""
        first, last = self.numbers[-3:][0], self.numbers[-1]
        formula, defaults = {
            "bands": (self.bands, {"gamma": 1, "first": first, "last": last}),
            "octree": (self.octree, {"offset": 0, "fade": 1}),
            "decay": (self.decay, {"s_v": 1, "at_most": 0}),
            "chunks": (self.chunks, {"distance_scale": 1, "chunks": 1, "fade": 1}),
            "cut": (self.cut, {"pixels": 1}),
            "prefix": (self.prefix, {"at_most": 0, "distance_scale": 1}),
        }[self.rule]
        self.position = np.array(position, float)
        values = defaults | self.controls | arguments
        return {
            n: formula(n, np.sqrt(((means - np.float32(position)) ** 2).sum(axis=1)), f, values)
            for n, means in self.means.items()
        }

    def bands(self, n: int, d: np.ndarray, f: float, values: dict) -> np.ndarray:
        used = [item for item in self.numbers if values["first"] <= item <= values["last"]]
        if n not in used:
            return np.zeros(len(d))
        border = {item: self.level_facts[item]["s_min"] / values["gamma"] * f for item in used}
        near = 0.0 if n == used[-1] else border[n]
        far = np.inf if n == used[0] else border[used[used.index(n) - 1]]
        return ((np.float32(near) <= d) & (d < np.float32(far))).astype(float)

    def chunks(self, n: int, d: np.ndarray, f: float, values: dict) -> np.ndarray:
        place = self.numbers.index(n)
        near = self.level_facts[n]["d_l"] if n != self.numbers[-1] else 0.0
        far = self.level_facts[self.numbers[place - 1]]["d_l"] if place else np.inf
        d = d * np.float32(values["distance_scale"])
        w = ((np.float32(near) <= d) & (d < np.float32(far))).astype(float)
        if not values["chunks"] or "chunks" not in self.tables:
            return w
        table = self.tables["chunks"]
        centres = np.array([table[axis] for axis in "xyz"], float).T
        distance = [float(np.linalg.norm(self.position - c)) for c in centres]
        a = distance.index(min(distance))
        t = {
            c: (self.position - centres[a]) @ (centre - centres[a]) / ((centre - centres[a]) ** 2).sum()
            for c, centre in enumerate(centres)
            if c != a
        }
        b, *remaining_ones = sorted(t, key=lambda c: -t[c])
        s = max([2 * t[c] - t[b] for c in remaining_ones] + [0])
        with_b = values["fade"] and t[b] > 0
        share = (t[b] - s) / (1 - 2 * s) if with_b else 0
        u = [1 - (distance[c] / float(table["radius"][c]) - 1) / 0.25 for c in ((a, b) if with_b else (a,))]
        u = min(max(*u, 0), 1) if values["fade"] else float(distance[a] <= table["radius"][a])

        def inside(c: int) -> np.ndarray:
            return (self.columns[n][f"chunks_{c // 24}"].astype(int) >> c % 24) % 2

        return u * ((1 - share) * inside(a) + share * inside(b)) + (1 - u) * w

    def cut(self, n: int, d: np.ndarray, f: float, values: dict) -> np.ndarray:
        k, columns = np.float32(max(f / values["pixels"], 8)), self.columns[n]
        parent = np.stack([columns[f"parent_{axis}"] for axis in "xyz"], axis=1)
        to_parent = np.sqrt(((parent - np.float32(self.position)) ** 2).sum(axis=1))
        with np.errstate(over="ignore"):
            return (d >= k * columns["node_size"]) & ~(to_parent >= k * columns["parent_size"])

    def octree(self, n: int, d: np.ndarray, f: float, values: dict) -> np.ndarray:
        bias = self.columns[n].get("lod_bias", np.zeros(len(d), np.float32)) + np.float32(values["offset"])
        reach = np.float32(self.facts["d_max"] * f / self.facts["d_max_focal"])
        with np.errstate(divide="ignore"):
            expected = 1 + np.clip(np.log2(reach / d) + bias, 0, self.numbers[-1] - 1)
        w = np.clip(2 * (expected - n + np.float32(0.5)) + np.float32(0.5), 0, 1)
        return w if values["fade"] else (w >= 0.5).astype(float)

    def prefix(self, n: int, d: np.ndarray, f: float, values: dict) -> np.ndarray:
        factor = self.facts["share"] ** 0.5 * f / self.facts["share_focal"] / values["distance_scale"]
        rank, reach = self.columns[n]["prefix_rank"], self.columns[n]["view_distance"] * np.float32(factor)
        with np.errstate(divide="ignore"):
            length = np.float32(self.facts["splats"]) * np.minimum(reach / d, np.float32(1)) ** 2
        return (rank < length) & (rank < (values["at_most"] or np.inf))

    def decay(self, n: int, d: np.ndarray, f: float, values: dict) -> np.ndarray:
        opacity, sigma = self.opacities[n], np.maximum(self.columns[n]["sigma_d"], 0)
        normalized = d / np.float32(self.facts["reference"] or d.max())

        def weights(s: float) -> np.ndarray:
            a = np.exp(-((normalized * s) ** 2) / (2 * sigma**2 + 1e-8))
            return np.where(opacity * a > self.facts["tau"] * s, a, 0)

        s = values["s_v"]
        if values["at_most"] and (weights(s) > 0).sum() > values["at_most"]:
            low, high = s, 1000.0  # any search with this count is valid
            for _ in range(60):
                middle = (low + high) / 2
                low, high = (
                    (middle, high) if (weights(middle) > 0).sum() > values["at_most"] else (low, middle)
                )
            s = high * (1 + 1e-5)
        return weights(s)


def levels(facts: dict[int, dict], columns: tuple[str, ...]) -> list[Level]:
    rng = np.random.default_rng(5)
    return [
        Level(
            n,
            Splats(
                rng.normal(0, 4, (300 * n, 3)).astype(np.float32),
                rng.normal(size=(300 * n, 4)).astype(np.float32),
                rng.normal(-2, 0.5, (300 * n, 3)).astype(np.float32),
                rng.normal(0, 2, 300 * n).astype(np.float32),
                rng.normal(size=(300 * n, 1, 3)).astype(np.float32),
                {name: rng.normal(size=300 * n).astype(np.float32) for name in columns},
            ),
            facts[n],
        )
        for n in facts
    ]


@pytest.fixture
def write_named(tmp_path):
    """``write_named(name)``: write a file or folder of that name."""
    sizes = {1: 0.4, 2: 0.1, 4: 0.03, 5: 0.01, 7: 0.0}  # numbers may have gaps
    bands = Bundle("flod", levels({n: {"s_min": s} for n, s in sizes.items()}, ()), "bands")
    bands.controls = {"gamma": 1.3, "first": 2}
    facts, controls = {"d_max": 25.0, "d_max_focal": 480.0}, {"offset": -0.25}
    of_octree = levels({n: {} for n in (1, 2, 3, 5)}, ("lod_bias",))
    octree = Bundle("octree", of_octree, "octree", facts, controls, True)
    fading = Bundle("clod", levels({1: {}}, ("sigma_d",)), "decay", {"reference": 9.5, "tau": 0.004})
    farthest = Bundle("clod", fading.levels, "decay", {"reference": 0.0, "tau": 0.004})
    begin = {1: 9.0, 3: 2.5, 4: 0.0}
    distances = Bundle("lodge", levels({n: {"d_l": d} for n, d in begin.items()}, ()), "chunks")
    rng = np.random.default_rng(6)
    in_chunks = levels({n: {"d_l": d} for n, d in begin.items()}, ())
    for level in in_chunks:
        level.splats.extras |= member_columns(rng.random((30, len(level.splats))) < 0.3)
    centres = {
        name: column.astype(np.float32) for name, column in zip("xyz", rng.normal(0, 3, (3, 30)), strict=True)
    }
    table = {"chunks": centres | {"radius": np.full(30, 2, np.float32)}}
    chunks = Bundle("lodge", in_chunks, "chunks", tables=table)
    tree_levels = levels({1: {}, 2: {}}, RULE.columns)
    for level, (size_factor, growth) in zip(tree_levels, ((0.03, 0.2), (0.0, 0.06)), strict=True):
        columns = level.splats.extras
        columns["node_size"] = np.float32(size_factor) * abs(columns["node_size"])
        columns["parent_size"] = columns["node_size"] + np.float32(growth) * abs(columns["parent_size"])
        columns["parent_size"][:1] = 3e38
    tree = Bundle("tree", tree_levels, "cut", controls={"pixels": 2.5})
    prefix_levels = levels({n: {} for n in (1, 2, 4)}, ("view_distance",))
    order = np.random.default_rng(7).permutation(300 * 7).astype(np.float32)
    for level, ranks in zip(prefix_levels, np.split(order, (300, 900)), strict=True):
        level.splats.extras["prefix_rank"] = ranks
        level.splats.extras["view_distance"] = np.float32(6) + level.splats.extras["view_distance"]
    facts = {"share": 0.4, "share_focal": 480.0, "splats": 2100.0}
    prefix = Bundle("matryoshka", prefix_levels, "prefix", facts, cumulative=True)
    bundles = {
        "tree": tree,
        "prefix": prefix,
        "distances": distances,
        "chunks": chunks,
        "bands": bands,
        "octree": octree,
        "decay": fading,
        "farthest": farthest,
    }

    def make(name: str) -> Path:
        path, bundle = tmp_path / name, bundles[name.split(maxsplit=1)[0]]
        if name.endswith("folder"):
            write_folder(path, bundle)
        else:
            write_bundle(path, bundle, "stream" if name.endswith("stream") else "finest_first")
        return path

    return make


BUNDLES = (
    "bands",
    "bands stream",
    "bands folder",
    "octree",
    "octree folder",
    "prefix",
    "prefix folder",
    "distances",
    "distances folder",
    "chunks",
    "decay",
    "decay folder",
    "farthest",
    "tree",
    "tree folder",
)


@pytest.mark.parametrize("name", BUNDLES)
def test_selection_from_the_documentation_matches(name, write_named):
    path = write_named(name)
    page, bundle = Page(path), (read_folder if path.is_dir() else read_bundle)(path)
    assert page.rule == bundle.rule and page.numbers == [level.number for level in bundle.levels]
    drawn = 0
    for position in POSITIONS:
        for f in FOCAL:
            for values in CHOICES[page.rule]:
                theirs = page.weights(position, f, values)
                for ours in select_levels(bundle, np.array(position), f, resolve_controls(bundle, values)):
                    weights, count = theirs[ours.number], len(ours.splats)
                    assert (weights > 0).sum() == count
                    total = count if ours.weights is None else ours.weights.sum(dtype=np.float64)
                    # a search for a budget ends at nearly the same scale
                    near = 1e-3 if values.get("at_most") else 1e-6
                    assert weights.sum(dtype=np.float64) == pytest.approx(total, rel=near, abs=1e-9)
                    drawn += count
    assert drawn > 1000


@pytest.mark.parametrize("name", rules())
def test_documentation_covers_every_rule_and_control(name):
    page = (ROOT / "docs" / "reference" / "bundle-rules.md").read_text(encoding="utf-8")
    assert f"## Rule `{name}`" in page
    section = page.split(f"## Rule `{name}`")[1].split("\n#")[0]
    rule = rules()[name]
    controls = [control.name for control in rule.controls]
    names = [*rule.scene_facts, *rule.level_facts, *rule.columns, *rule.tables, *controls]
    assert [item for item in names if f"`{item}`" not in section] == []
