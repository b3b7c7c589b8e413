"""Seams: their base, their training, and the merged result."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.methods import create
from training.optimize.parameters import override
from training.optimize.training_data import TrainingData
from training.runs.cells import merge as merge_module
from training.runs.cells.merge import merge, write_surroundings
from training.runs.cells.plan import SEAM_PARAMETERS, Division, Part
from training.runs.folder import RunFolder
from training.scenes.colmap import read_scene
from training.scenes.regions import Region
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply

from .test_cells import finished, random_splats

FAR = 1e9


def divided(folder, rng, counts=(20, 50), **header) -> tuple[Division, list[list[Splats]]]:
    """Three cells in a row with borders at -0.3 and 0.4, enlarged by 0.1, and their untrained seams."""
    sets = [[random_splats(rng, n) for n in counts] for _ in range(3)]
    borders = [-np.inf, -0.3, 0.4, np.inf]
    cells, seams = [], []
    for number, levels in enumerate(sets, 1):
        cell = finished(folder, number, (0, 1), levels, **header)
        limits = np.array([borders[number - 1 : number + 1], [-np.inf, np.inf]])
        region = Region(np.eye(3), limits, limits + 0.1 * np.array([[-1, 1], [0, 0]]), ("a", "b"))
        cells.append(replace(cell, region=region))
        run = RunFolder(folder / "seams" / str(number))
        run.create()
        seams.append(Part(number, run, replace(region, seam=True)))
    return Division(None, cells, seams), sets


def x_of(splats: Splats) -> np.ndarray:
    return splats.means[:, 0]


def test_base_of_a_seam_has_its_cell_its_neighbours_and_distant_splats_of_its_cell(tmp_path, monkeypatch):
    monkeypatch.setattr(merge_module, "BATCH_ROWS", 7)
    division, sets = divided(tmp_path, np.random.default_rng(0))
    write_surroundings(division, division.seams[1])
    base = read_ply(division.seams[1].folder.base)
    left, middle, right = (levels[-1] for levels in sets)
    x = x_of(middle)
    expected = Splats.concatenated(
        [
            left.select((x_of(left) >= -0.4) & (x_of(left) < -0.3)),
            middle.select(((x >= -0.3) & (x < 0.4)) | (x < -0.4) | (x >= 0.5)),
            right.select((x_of(right) >= 0.4) & (x_of(right) < 0.5)),
        ]
    )
    assert len(base) == len(expected) > 20
    for name in ("means", "sh", "log_scales"):
        np.testing.assert_array_equal(getattr(base, name), getattr(expected, name))
    content = division.seams[1].folder.base.read_bytes()
    division.cells[0].folder.bundle.unlink()
    write_surroundings(division, division.seams[1])
    assert division.seams[1].folder.base.read_bytes() == content, "an existing base is kept"


def test_base_of_a_seam_has_all_cumulative_levels(tmp_path):
    division, sets = divided(
        tmp_path, np.random.default_rng(0), method="octree", rule="octree", cumulative=True
    )
    write_surroundings(division, division.seams[0])
    cell_splats = Splats.concatenated(sets[0])
    base = read_ply(division.seams[0].folder.base)
    np.testing.assert_array_equal(
        base.means[np.isin(base.means, cell_splats.means).all(1)],
        cell_splats.means[(x_of(cell_splats) < -0.3) | (x_of(cell_splats) >= -0.2)],
    )


@pytest.mark.parametrize("cumulative", [False, True])
def test_merge_takes_only_colours_and_opacities_near_borders_from_seams(tmp_path, cumulative):
    kind = {"method": "octree", "rule": "octree", "cumulative": True} if cumulative else {}
    division, _ = divided(tmp_path, np.random.default_rng(0), **kind)
    plain = replace(division, seams=[])
    counts = merge(plain, tmp_path / "plain.ply")
    for seam in division.seams:
        write_surroundings(division, seam)
        base = read_ply(seam.folder.base)
        borders = seam.region.near_border(base.means)
        inside = np.abs(x_of(base)[:, None] - [-0.3, 0.4]).min(axis=1) < 0.1
        np.testing.assert_array_equal(borders, inside & seam.region.contains(base.means))
        trained = replace(
            base, sh=base.sh + np.float32(0.5), opacity_logits=base.opacity_logits - np.float32(1)
        )
        write_bundle(seam.folder.bundle, Bundle("3dgs", [Level(1, trained)]))
    assert merge(division, tmp_path / "fitted.ply") == counts
    plain_bundle, fitted_bundle = read_bundle(tmp_path / "plain.ply"), read_bundle(tmp_path / "fitted.ply")
    count = 0
    for level, fitted in zip(plain_bundle.levels, fitted_bundle.levels, strict=True):
        at_border = np.abs(x_of(level.splats)[:, None] - [-0.3, 0.4]).min(axis=1) < 0.1
        if not cumulative and level.number == 1:
            at_border[:] = False
        count += at_border.sum()
        change = at_border[:, None, None] * np.float32(0.5)
        np.testing.assert_array_equal(fitted.splats.sh, level.splats.sh + change)
        np.testing.assert_array_equal(
            fitted.splats.opacity_logits, level.splats.opacity_logits - at_border.astype(np.float32)
        )
        for name in ("means", "quats", "log_scales"):
            np.testing.assert_array_equal(getattr(fitted.splats, name), getattr(level.splats, name))
        np.testing.assert_array_equal(fitted.splats.extras["lod_level"], level.splats.extras["lod_level"])
    assert count > 5


def test_seam_trained_from_other_cells_is_rejected(tmp_path):
    division, _ = divided(tmp_path, np.random.default_rng(0))
    for seam in division.seams:
        write_bundle(
            seam.folder.bundle, Bundle("3dgs", [Level(1, random_splats(np.random.default_rng(5), 40))])
        )
    with pytest.raises(LodgsError, match="was not trained from the current cells"):
        merge(division, tmp_path / "merged.ply")
    assert not (tmp_path / "merged.ply").exists()


def test_missing_levels_come_from_the_coarse_part(tmp_path):
    rng = np.random.default_rng(1)
    division, sets = divided(tmp_path, rng)
    for cell, levels_of_cell in zip(division.cells, sets, strict=True):
        levels = [
            Level(number, splats, {"s_min": 1 / number})
            for number, splats in zip((2, 3), levels_of_cell, strict=True)
        ]
        write_bundle(cell.folder.bundle, Bundle("flod", levels, "bands"))
    coarse = RunFolder(tmp_path / "coarse")
    coarse.create()
    two = [random_splats(rng, 9), random_splats(rng, 11)]
    levels = [Level(number, splats, {"s_min": 7.0 / number}) for number, splats in enumerate(two, 1)]
    write_bundle(coarse.bundle, Bundle("flod", levels, "bands"))
    merge(Division(Part(0, coarse, None), division.cells, []), tmp_path / "merged.ply")
    merged = read_bundle(tmp_path / "merged.ply")
    assert [(level.number, level.facts["s_min"]) for level in merged.levels] == [
        (1, 7.0),
        (2, 0.5),
        (3, 1 / 3),
    ]
    np.testing.assert_array_equal(merged.levels[0].splats.means, two[0].means)
    assert len(merged.levels[2].splats) < sum(len(levels[1]) for levels in sets)


def test_seam_steps_change_only_colours_and_opacities_of_free_splats(tiny_scene):
    data = TrainingData(read_scene(tiny_scene), test_every=4)
    rng = np.random.default_rng(0)
    base = random_splats(rng, 200)
    values = {**SEAM_PARAMETERS, "lr_exposure": 0.0, "steps": 8, "max_splats": 200, "sh_degree": 1}
    method = create("3dgs", data, override(create_parameters(), values), 0, "cpu", base)
    frozen = torch.from_numpy(rng.random(200) < 0.5)
    method.model.freeze_rows(frozen)
    for step in range(8):
        assert method.sh_degree(step) == 1 and method.shrink(step) == 1
        method.train_step(step)
    trained = method.model.splats()
    for name in ("means", "quats", "log_scales"):
        np.testing.assert_array_equal(getattr(trained, name), getattr(base, name))
    changed = (trained.sh != base.sh).any(axis=(1, 2)) | (trained.opacity_logits != base.opacity_logits)
    assert not changed[frozen.numpy()].any() and changed[~frozen.numpy()].sum() > 50


def create_parameters():
    from training.methods import method_info

    return method_info("3dgs").preset("draft")
