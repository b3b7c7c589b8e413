"""Seams: what they begin with, what they leave alone, and what comes of it in the bundle."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.methods import create
from training.optimize.parameters import override
from training.optimize.training_data import TrainingData
from training.runs.blocks import merge as merge_module
from training.runs.blocks.merge import merge, write_surroundings
from training.runs.blocks.plan import SEAM_PARAMETERS, Block, Division
from training.runs.folder import RunFolder
from training.scenes.colmap import read_scene
from training.scenes.regions import Region
from training.splats.bundle import Bundle, Level, read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.ply import read_ply

from .test_blocks import finished, random_splats

FAR = 1e9


def divided(folder, rng, counts=(20, 50), **further) -> tuple[Division, list[list[Splats]]]:
    """Three blocks in a row, whose borders lie at -0.3 and 0.4, enlarged by 0.1, with seams to be trained."""
    sets = [[random_splats(rng, n) for n in counts] for _ in range(3)]
    ends = [-np.inf, -0.3, 0.4, np.inf]
    blocks, seams = [], []
    for number, its in enumerate(sets, 1):
        block = finished(folder, number, (0, 1), its, **further)
        cell = np.array([ends[number - 1 : number + 1], [-np.inf, np.inf]])
        region = Region(np.eye(3), cell, cell + 0.1 * np.array([[-1, 1], [0, 0]]), ("a", "b"))
        blocks.append(replace(block, region=region))
        run = RunFolder(folder / "seams" / str(number))
        run.create()
        seams.append(Block(number, run, replace(region, seam=True)))
    return Division(None, blocks, seams), sets


def x_of(splats: Splats) -> np.ndarray:
    return splats.means[:, 0]


def test_a_seam_begins_with_the_cell_its_neighbours_and_what_its_own_block_has_beyond(tmp_path, monkeypatch):
    monkeypatch.setattr(merge_module, "BATCH_ROWS", 7)
    division, sets = divided(tmp_path, np.random.default_rng(0))
    write_surroundings(division, division.seams[1])
    found = read_ply(division.seams[1].folder.base)
    left, own, right = (its[-1] for its in sets)
    wanted = Splats.concatenated([
        left.select((x_of(left) >= -0.4) & (x_of(left) < -0.3)),
        own.select(((x_of(own) >= -0.3) & (x_of(own) < 0.4)) | (x_of(own) < -0.4) | (x_of(own) >= 0.5)),
        right.select((x_of(right) >= 0.4) & (x_of(right) < 0.5)),
    ])  # fmt: skip
    assert len(found) == len(wanted) > 20
    for name in ("means", "sh", "log_scales"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    before = division.seams[1].folder.base.read_bytes()
    division.blocks[0].folder.bundle.unlink()
    write_surroundings(division, division.seams[1])
    assert division.seams[1].folder.base.read_bytes() == before, "it is made once"


def test_of_levels_that_add_up_all_are_there(tmp_path):
    division, sets = divided(
        tmp_path, np.random.default_rng(0), method="octree", rule="octree", cumulative=True
    )
    write_surroundings(division, division.seams[0])
    own = Splats.concatenated(sets[0])
    found = read_ply(division.seams[0].folder.base)
    np.testing.assert_array_equal(
        found.means[np.isin(found.means, own.means).all(1)],
        own.means[(x_of(own) < -0.3) | (x_of(own) >= -0.2)],
    )


@pytest.mark.parametrize("cumulative", [False, True])
def test_colours_and_opacities_at_borders_come_from_seams_and_nothing_else_does(tmp_path, cumulative):
    kind = {"method": "octree", "rule": "octree", "cumulative": True} if cumulative else {}
    division, _ = divided(tmp_path, np.random.default_rng(0), **kind)
    plain = replace(division, seams=[])
    kept = merge(plain, tmp_path / "plain.ply")
    for seam in division.seams:
        write_surroundings(division, seam)
        begun = read_ply(seam.folder.base)
        borders = seam.region.near_border(begun.means)
        inside = np.abs(x_of(begun)[:, None] - [-0.3, 0.4]).min(axis=1) < 0.1
        np.testing.assert_array_equal(borders, inside & seam.region.contains(begun.means))
        moved = replace(
            begun, sh=begun.sh + np.float32(0.5), opacity_logits=begun.opacity_logits - np.float32(1)
        )
        write_bundle(seam.folder.bundle, Bundle("3dgs", [Level(1, moved)]))
    assert merge(division, tmp_path / "fitted.ply") == kept
    one, other = read_bundle(tmp_path / "plain.ply"), read_bundle(tmp_path / "fitted.ply")
    fitted = 0
    for before, after in zip(one.levels, other.levels, strict=True):
        at_border = np.abs(x_of(before.splats)[:, None] - [-0.3, 0.4]).min(axis=1) < 0.1
        if not cumulative and before.number == 1:
            at_border[:] = False
        fitted += at_border.sum()
        change = at_border[:, None, None] * np.float32(0.5)
        np.testing.assert_array_equal(after.splats.sh, before.splats.sh + change)
        np.testing.assert_array_equal(
            after.splats.opacity_logits, before.splats.opacity_logits - at_border.astype(np.float32)
        )
        for name in ("means", "quats", "log_scales"):
            np.testing.assert_array_equal(getattr(after.splats, name), getattr(before.splats, name))
        np.testing.assert_array_equal(after.splats.extras["lod_level"], before.splats.extras["lod_level"])
    assert fitted > 5


def test_a_seam_of_other_blocks_is_refused(tmp_path):
    division, _ = divided(tmp_path, np.random.default_rng(0))
    for seam in division.seams:
        write_bundle(
            seam.folder.bundle, Bundle("3dgs", [Level(1, random_splats(np.random.default_rng(5), 40))])
        )
    with pytest.raises(LodgsError, match="was not trained from the blocks"):
        merge(division, tmp_path / "whole.ply")
    assert not (tmp_path / "whole.ply").exists()


def test_levels_that_no_block_has_are_the_coarse_runs(tmp_path):
    rng = np.random.default_rng(1)
    division, sets = divided(tmp_path, rng)
    for block, its in zip(division.blocks, sets, strict=True):
        levels = [
            Level(number, splats, {"s_min": 1 / number}) for number, splats in zip((2, 3), its, strict=True)
        ]
        write_bundle(block.folder.bundle, Bundle("flod", levels, "bands"))
    coarse = RunFolder(tmp_path / "coarse")
    coarse.make()
    two = [random_splats(rng, 9), random_splats(rng, 11)]
    levels = [Level(number, splats, {"s_min": 7.0 / number}) for number, splats in enumerate(two, 1)]
    write_bundle(coarse.bundle, Bundle("flod", levels, "bands"))
    merge(Division(Block(0, coarse, None), division.blocks, []), tmp_path / "whole.ply")
    made = read_bundle(tmp_path / "whole.ply")
    assert [(level.number, level.facts["s_min"]) for level in made.levels] == [(1, 7.0), (2, 0.5), (3, 1 / 3)]
    np.testing.assert_array_equal(made.levels[0].splats.means, two[0].means)
    assert len(made.levels[2].splats) < sum(len(its[1]) for its in sets)


def test_steps_of_a_seam_change_colours_and_opacities_of_what_is_not_held(tiny_scene):
    data = TrainingData(read_scene(tiny_scene), test_every=4)
    rng = np.random.default_rng(0)
    base = random_splats(rng, 200)
    values = {**SEAM_PARAMETERS, "lr_exposure": 0.0, "steps": 8, "max_splats": 200, "sh_degree": 1}
    method = create("3dgs", data, override(create_parameters(), values), 0, "cpu", base)
    held = torch.from_numpy(rng.random(200) < 0.5)
    method.model.hold(held)
    for step in range(8):
        assert method.sh_degree(step) == 1 and method.shrink(step) == 1
        method.train_step(step)
    made = method.model.splats()
    for name in ("means", "quats", "log_scales"):
        np.testing.assert_array_equal(getattr(made, name), getattr(base, name))
    changed = (made.sh != base.sh).any(axis=(1, 2)) | (made.opacity_logits != base.opacity_logits)
    assert not changed[held.numpy()].any() and changed[~held.numpy()].sum() > 50


def create_parameters():
    from training.methods import method_info

    return method_info("3dgs").preset("draft")
