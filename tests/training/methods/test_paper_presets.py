"""Published numbers of presets *paper*, and the steps at which these densify, prune, reset and join levels.

Sources: "Sec.", "A." and "App." are sections of the papers' texts. "program" is an argument of the authors'
published program, cited where the text has no number. "not published" marks choices of this project.
"""

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from training.lod.rules import decay
from training.methods import METHODS, create, lodge, method_info
from training.methods.flod import train as flod_train
from training.optimize import density_control, splat_method
from training.optimize.anchors import growing, networks
from training.optimize.out_of_core import cut_cache, view_order
from training.optimize.parameters import override
from training.rasterize import adam

OCTREE_PAGE = Path(__file__).parents[3] / "docs/methods/octree-gs-paper.md"

SHARED = {
    "max_splats": (0, "no paper limits the number"),
    "scale_threshold": (False, "3DGS program: densify_grad_threshold is used unchanged"),
    "sparse_sh": (False, "3DGS program: steps of Adam for all splats"),
    "ssim_weight": (0.2, "3DGS program: lambda_dssim; Octree-GS, Sec. 7.1"),
    "min_opacity": (0.005, "3DGS program: 0.005 in train.py; FLoD and Octree-GS programs: arguments"),
    "antialias": (False, "3DGS program: dilation"),
    "free_depth": (0.0, "no paper has it"),
    "largest": (0.0, "no paper has it"),
    "random_background": (False, "3DGS program: random_background"),
    "margin": (0.0, "no paper has it"),
    "dropout": (0.0, "no paper has it"),
    "match_exposure": (False, "no paper has it"),
    "lr_exposure": (0.0, "A LoD of Gaussians, A.4: disabled; other papers: none"),
    "depth_weight": (0.0, "A LoD of Gaussians, A.4: off without depth maps; other papers: none"),
}
RATES = {
    "sh_degree": (3, "3DGS program: sh_degree"),
    "sh_interval": (1000, "3DGS program: every 1,000 iterations"),
    "lr_means": (1.6e-4, "3DGS program: position_lr_init"),
    "lr_means_final": (1.6e-6, "3DGS program: position_lr_final"),
    "lr_scales": (0.005, "3DGS and FLoD programs: scaling_lr"),
    "lr_quats": (1e-3, "3DGS program: rotation_lr"),
    "lr_opacities": (0.05, "3DGS program: opacity_lr"),
    "lr_sh": (0.0025, "3DGS program: feature_lr"),
}
SPLATS = (
    SHARED
    | RATES
    | {
        "grad_threshold": (2e-4, "3DGS program: densify_grad_threshold"),
        "lr_final": (1.0, "3DGS program: constant rates, except those of positions"),
        "lr_means_steps": (30_000, "3DGS program: position_lr_max_steps"),
        "clone_extent": (0.01, "3DGS program: percent_dense"),
        "long_axis": (False, "3DGS program: clone and split"),
        "first_resolution": (1.0, "3DGS program: full images from the first step"),
        "far_share": (0.0, "no paper has it"),
        "points_between": (0.0, "no paper has it"),
        "opacity_decay": (0.0, "no paper has it"),
        "opacity_reset_interval": (3000, "3DGS program: opacity_reset_interval"),
        "prune_interval": (100, "3DGS program: densify_and_prune"),
        "densify_from": (501, "3DGS program: iteration > densify_from_iter = 500"),
    }
)
SINGLE = SPLATS | {
    "steps": (30_000, "3DGS program: iterations; CLoD-GS, Sec. 4.1"),
    "densify_interval": (100, "3DGS program: densification_interval"),
    "densify_until": (0.499, "3DGS program: iteration < densify_until_iter = 15,000"),
    "prune_oversized": (True, "3DGS program: size_threshold after the first reset"),
    "densify_by": ("mean", "3DGS program: mean gradient"),
    "least_weight": (0.0, "3DGS: none"),
}
FLOD = {
    "levels": (5, "FLoD, Sec. 6.1.4: L_max"),
    "rho": (4.0, "FLoD, Sec. 6.1.4"),
    "steps": ((10_000, 15_000, 20_000, 25_000, 30_000), "FLoD, Sec. 6.1.4"),
    "budget_ratio": (1.0, "FLoD: none"),
}
FLOD_UNTIL = (
    (0.499, 0.399, 0.399, 0.399, 0.499),
    "FLoD, Sec. 6.1.4: 5,000, 6,000, 8,000, 10,000, 15,000; program: iteration below it",
)
NEURAL_RATES = {
    "lr_features": (7.5e-3, "Octree-GS program: feature_lr"),
    "lr_offsets": (1e-2, "Octree-GS program: offset_lr_init"),
    "lr_offsets_final": (1e-4, "Octree-GS program: offset_lr_final"),
    "lr_scales": (7e-3, "Octree-GS program: scaling_lr"),
    "lr_network": (2e-3, "Octree-GS program: mlp_opacity_lr_init"),
    "lr_network_final": (0.01, "Octree-GS program: mlp_opacity_lr_final = 2e-5"),
    "lr_appearance": (0.05, "Octree-GS program: appearance_lr_init"),
    "scale_offset_rate": (True, "Octree-GS program: offset_lr_init * spatial_lr_scale"),
}
FLOD_INTERVALS = ((2000, 1000, 500, 500, 200), "FLoD, Sec. 6.1.4")
OCTREE = SHARED | {
    "steps": (40_000, "Octree-GS, Sec. 7.1: 10,000 and 30,000"),
    "levels": (0, "Octree-GS, Eq. 3"),
    "nearest": (0.05, "Octree-GS, Sec. 4.1 (program: dist_ratio = 0.999)"),
    "farthest": (0.95, "Octree-GS, Sec. 4.1 (program: dist_ratio = 0.999)"),
    "coarser_levels": (0, "Octree-GS: none"),
    "coarse_share": (0.25, "Octree-GS, Sec. 7.1: 10,000 of 40,000"),
    "coarse_factor": (1.5, "Octree-GS program: coarse_factor"),
    "joins": ("published", "Octree-GS, Sec. 4.3: floor(K/2); program: the last at coarse_iter"),
    "init_level": (-1, "Octree-GS, Sec. 7.1: half of the levels"),
    "footprint": (1.0, "Octree-GS: epsilon, not published"),
    "stats_from": (500, "Octree-GS program: start_stat"),
    "grow_from": (1500, "Octree-GS program: update_from"),
    "grow_until": (0.6249, "Octree-GS program: iteration < update_until = 25,000"),
    "grow_interval": (100, "Octree-GS, Sec. 5.1: T"),
    "grow_next": (True, "Octree-GS, Sec. 4.2"),
    "grad_threshold": (2e-4, "Octree-GS, Sec. 5.1: tau_g"),
    "grow_harder": (0.2, "Octree-GS, Sec. 5.1: beta"),
    "room_exponent": (0.0, "Octree-GS: no limit"),
    "bias_rate": (0.01, "Octree-GS program: extra_up"),
    "visible_share": (0.0, "Octree-GS program: visible_threshold"),
    "far_share": (0.0, "Octree-GS: none"),
    "full_share": (0.0, "Octree-GS: none"),
    "least_weight": (0.0, "Octree-GS: none"),
    "narrowest": (0.0, "Octree-GS: levels of anchors are constant"),
    "widest": (1e9, "Octree-GS: levels of anchors are constant"),
    "lr_end": (1.0, "Octree-GS program: scaling_lr and feature_lr are constant"),
}
PUBLISHED = {
    "3dgs": SINGLE,
    "flod": SPLATS | FLOD | {
        "footprint": (40.0, "FLoD, Sec. 6.1.4: lambda = 0.2, about 40 pixels at the median depth"),
        "densify_until": FLOD_UNTIL,
        "densify_interval": FLOD_INTERVALS,
        "levels_from": ("trained", "FLoD, Sec. 4.2"),
        "overlap_interval": (1000, "FLoD, Sec. 6.1.4"),
        "prune_interval": (100, "FLoD program: pruning_interval"),
        "rejoin_points": (False, "FLoD: none"),
        "finish_share": (0.0, "FLoD: none"),
    },
    "lodge": SPLATS | {
        "steps": (30_000, "LODGE, A.2"),
        "total_steps": (36_000, "LODGE, Sec. 4: 36K iterations"),
        "antialias": (True, "LODGE, A.2: 2D filter of Mip-Splatting"),
        "densify_from": (600, "LODGE, A.2"),
        "densify_interval": (300, "LODGE, A.2"),
        "prune_interval": (300, "3DGS program: densify_and_prune; LODGE, A.2: every 300 steps"),
        "densify_until": (0.5, "LODGE, A.2: to step 15,000"),
        "densify_by": ("max", "LODGE, Eq. 6"),
        "max_threshold": (0.015, "LODGE, A.2: Hierarchical 3DGS data set"),
        "least_weight": (0.02, "LODGE, A.2: all scenes but Campus"),
        "tune_steps": (1000, "LODGE, A.2"),
        "tune_range": (0.3, "LODGE, A.2: U(0.7 d, 1.3 d)"),
        "levels_from": ("pruned", "LODGE, Sec. 3: copies of G(0)"),
        "distances": ((0.0, 0.0, 0.0), "LODGE, Sec. 3: chosen from the scene"),
        "chunks": (0, "LODGE, Eq. 5"),
        "levels": (3, "LODGE, Sec. 4, performance analysis: two LODs for all experiments"),
        "prune_oversized": (False, "LODGE, A.2: the strategy of H3DGS, whose program has none"),
        "tune_each": (True, "LODGE, A.2: each d_l"),
        "min_ratio": (1.3, "LODGE, Table 3: 10, 28, 47 and 63 m"),
        "min_chunks": (2, "LODGE, Eq. 5: no minimum"),
        "tune_alone": (0.0, "LODGE: none"),
        "drawn": (1.0, "LODGE: none"),
        "keep": (1.0, "LODGE: none"),
        "prune_weight": (0.02, "LODGE: gamma, not published"),
        "visible_weight": (0.01, "LODGE: not published"),
        "filter_variance": (0.2, "LODGE: s, not published; Mip-Splatting program"),
    },
    "tree": SPLATS | {
        "steps": (60_000, "A LoD of Gaussians, A.5 (A.2: 100k, as MC-small-city+ in A.5)"),
        "densify_until": (0.0, "A LoD of Gaussians, A.2: no densification"),
        "opacity_reset_interval": (0, "A LoD of Gaussians, Sec. 4.2: no opacity resets"),
        "densify_by": ("mean", "A LoD of Gaussians, A.2: no densification"),
        "least_weight": (0.0, "A LoD of Gaussians: none"),
        "prune_oversized": (False, "A LoD of Gaussians, A.2: no densification"),
        "tune_steps": (150_000, "A LoD of Gaussians, A.5"),
        "merge_by": ("size", "A LoD of Gaussians, Eq. 6"),
        "octaves": (0.0, "A LoD of Gaussians, A.6: 1 + 5 r^4"),
        "resize_interval": (1000, "A LoD of Gaussians, Sec. 4.3: after each densification"),
        "sh_degree": (1, "A LoD of Gaussians, A.5"),
        "lod_noise": (5.0, "A LoD of Gaussians, A.6"),
        "max_threshold": (0.0075, "A LoD of Gaussians, A.5: half of H3DGS's 0.015"),
        "unseen_epochs": (2.0, "A LoD of Gaussians, A.6"),
        "sky_points": (0, "A LoD of Gaussians, A.2: number not published, off"),
        "pixels": (3.0, "A LoD of Gaussians: not published"),
        "node_rate": (1.0, "A LoD of Gaussians: rates not published, 3DGS's"),
        "node_end": (1.0, "A LoD of Gaussians: rates not published, 3DGS's are constant"),
        "leaf_rate": (1.0, "A LoD of Gaussians: rates not published, 3DGS's"),
        "leaf_end": (1.0, "A LoD of Gaussians: rates not published, 3DGS's are constant"),
        "grow_interval": (1000, "A LoD of Gaussians: not published"),
        "grow_until": (0.85, "A LoD of Gaussians: not published"),
    },
    "octree": OCTREE | RATES | {  # explicit anchors are in the program of the successor only
        "sh_degree": (3, "Octree-AnyGS program, 3dgs: max_sh_degree"),
        "levels_from": ("anchors", "Octree-GS, Sec. 4.1"),
        "lr_means": (1.6e-4, "3DGS program: position_lr_init; anchors have offsets in Octree-AnyGS"),
        "candidates": (1, "Octree-AnyGS program, 3dgs: n_offsets"),
        "volume_weight": (0.0, "Octree-AnyGS program, 3dgs: lambda_dreg"),
    },
    "flod_scaffold": SHARED | FLOD | NEURAL_RATES | {  # settings of FLoD-3DGS; others are not published
        "coarsest": (40.0, "FLoD, Sec. 6.1.4: lambda = 0.2, about 40 pixels at the median depth"),
        "grow_until": FLOD_UNTIL,
        "grow_interval": FLOD_INTERVALS,
        "grad_threshold": (2e-4, "Octree-GS, Sec. 5.1: tau_g"),
        "stats_from": (500, "Octree-GS program: start_stat"),
        "grow_from": (1500, "Octree-GS program: update_from"),
        "footprint": (1.0, "FLoD: not published, voxels are at least the minimum size"),
        "farthest": (0.95, "Octree-GS, Sec. 4.1"),
        "success_threshold": (0.8, "Octree-GS program: success_threshold"),
        "offsets": (10, "Octree-GS program: n_offsets"),
        "features": (32, "Octree-GS program: feat_dim"),
        "appearance": (0, "FLoD: not published, off"),
        "volume_weight": (0.01, "Octree-GS, Sec. 7.1: as Scaffold-GS"),
        "direct": (False, "Octree-GS: networks alone"),
        "view_shapes": (True, "Octree-GS program: the view direction is an input of all networks"),
        "least_weight": (0.0, "FLoD: none"),
        "lr_end": (1.0, "Octree-GS program: scaling_lr and feature_lr are constant"),
    },
    "octree_neural": OCTREE | NEURAL_RATES | {
        "success_threshold": (0.8, "Octree-GS program: success_threshold"),
        "offsets": (10, "Octree-GS program: n_offsets"),
        "features": (32, "Octree-GS program: feat_dim"),
        "appearance": (32, "Octree-GS, Sec. 7.2: dimension 32"),
        "volume_weight": (0.01, "Octree-GS, Sec. 7.1"),
        "direct": (False, "Octree-GS: networks alone"),
        "view_shapes": (True, "Octree-GS program: the view direction is an input of all networks"),
    },
    "clod": SINGLE | {
        "begin": (1 / 6, "CLoD-GS, Sec. 4.1: from step 5,000"),
        "lr_sigma": (0.01, "CLoD-GS, Sec. 4.1"),
        "s_v_most": (5.0, "CLoD-GS, Sec. 4.3"),
        "sigma_init": (0.0, "CLoD-GS: not published, from the scene"),
        "count_of": ("all", "CLoD-GS, Sec. 3.3: N_total"),
        "reference_quantile": (0.0, "CLoD-GS, Sec. 3.2: farthest in N_view"),
        "prune_undrawn": (False, "CLoD-GS: none"),
        "exponent": (1.5, "CLoD-GS, Sec. 3.3"),
        "count_weight": (1.0, "CLoD-GS, Sec. 4.1: lambda_reg"),
        "count_softness": (0.5, "CLoD-GS: not published"),
        "scale_weight": (True, "CLoD-GS, Eq. 3: w_s"),
        "onset": (1.0, "CLoD-GS, Sec. 3.3: target s_v^-1.5 from 1 on"),
        "log_uniform": (False, "CLoD-GS, Sec. 3.3: U(1, s_v_most)"),
        "log_sigma": (False, "CLoD-GS, Eq. 2: ReLU(sigma)"),
        "tau": (1 / 255, "CLoD-GS: not published, least opacity that 3DGS draws"),
        "count_opacities": (False, "CLoD-GS: not published"),
        "by_importance": (False, "CLoD-GS: none"),
        "keep_share": (1.0, "CLoD-GS: none"),
        "random_weight": (1.0, "CLoD-GS, Eq. 4"),
    },
    "matryoshka": SINGLE | {
        "base_share": (0.0, "Matryoshka: none"),
        "begin": (0.0, "Matryoshka, abstract: each iteration samples a budget"),
        "prefix_weight": (1.0, "Matryoshka, abstract: optimises both the prefix and the full set"),
        "log_uniform": (False, "Matryoshka: distribution not known to us, uniform"),
        "min_prefix": (0.01, "Matryoshka: not known to us"),
        "order_interval": (1000, "Matryoshka: not known to us"),
        "order_by": ("largest", "Matryoshka: ordering not known to us"),
    },
}  # fmt: skip
_DENSITY = ("depth", "full_resolution")  # without depth weight, with full images from the first step
_MERGED = ("merge_ratio", "refine_steps", "drawn")  # only of merged levels
_NEURAL = ("depth", "sh_degree", "bake_ridge", "appearance_of", "lr_looks")  # of baking and own looks
NO_EFFECT = {
    "3dgs": (*_DENSITY, "max_threshold"),
    "flod": (*_DENSITY, *_MERGED, "finish_alone", "s_min_1", "first_level", "last_level"),
    "lodge": _DENSITY,
    "tree": (*_DENSITY, "densify_interval"),
    "octree": ("depth", *_MERGED, "merged_levels"),
    "flod_scaffold": (*_NEURAL, "s_min_1"),
    "octree_neural": _NEURAL,
    "clod": (*_DENSITY, "max_threshold"),
    "matryoshka": (*_DENSITY, "max_threshold", "levels", "level_ratio", "drawn"),  # levels are prefixes
}
"""Parameters that have no effect on the training of preset *paper*."""
CONSTANTS = [
    (adam.EPS, 1e-15, "3DGS program: Adam's eps"),
    (density_control.RESET_OPACITY, 0.01, "3DGS program: reset_opacity"),
    (density_control.OVERSIZED_PIXELS, 20, "3DGS program: size_threshold"),
    (density_control.OVERSIZED_EXTENT, 0.1, "3DGS program: 0.1 * extent"),
    (splat_method.PRUNE_AT, (8 / 30, 16 / 30, 24 / 30), "LODGE, A.2: 8,000, 16,000 and 24,000 of 30,000"),
    (lodge.ROUNDS, (0.2, 0.6, 1.0), "LODGE, A.2: 0.2, 0.6 and 1 times gamma"),
    (networks.HIDDEN, 32, "Octree-GS program: one hidden layer of feat_dim"),
    (decay.EPSILON, 1e-8, "CLoD-GS, Eq. 2: not published"),
    (view_order.BLOCK, 128, "A LoD of Gaussians, Sec. 4.4"),
    (view_order.NEIGHBORS, 100, "A LoD of Gaussians program: k"),
    (cut_cache.FLUSH_INTERVAL, 1000, "A LoD of Gaussians, Sec. 4.4"),
    (cut_cache.REUSE, (0.77, 2.0), "A LoD of Gaussians program: D_min, D_max"),
]


@pytest.mark.parametrize("name", PUBLISHED)
def test_paper_presets_have_published_numbers(name):
    paper = method_info(name).preset("paper")
    for parameter, (value, source) in PUBLISHED[name].items():
        assert getattr(paper, parameter) == pytest.approx(value), f"{parameter}: {source}"


@pytest.mark.parametrize("name", METHODS)
def test_every_parameter_of_presets_paper_has_a_source(name):
    used = {f.name for f in method_info(name).fields if f.name not in NO_EFFECT[name]}
    missing = sorted(used - PUBLISHED[name].keys())
    assert not missing, f"add {missing} to PUBLISHED with a source, or to NO_EFFECT"


@pytest.mark.parametrize(("constant", "value", "source"), CONSTANTS)
def test_constants_have_published_numbers(constant, value, source):
    assert constant == pytest.approx(value), source


@pytest.fixture
def events(monkeypatch):
    """Return run(method): the steps of a run that call each function of density control."""

    def run(method) -> dict[str, list[int]]:
        calls: dict[str, list[int]] = {}

        def watch(owner, name: str, result=lambda *_: None) -> None:
            def record(*arguments, **_):
                calls.setdefault(name, []).append(step + 1)
                return result(*arguments)

            monkeypatch.setattr(owner, name, record)

        for name in ("densify", "prune", "prune_oversized", "reset_opacities"):
            for module in (splat_method, flod_train):
                if hasattr(module, name):
                    watch(module, name)
        watch(flod_train, "well_separated", lambda means, _: torch.ones(len(means), dtype=torch.bool))
        if hasattr(type(method), "prune_unimportant"):
            watch(type(method), "prune_unimportant")
        for step in range(method.steps):
            if method.parameters.prune_interval and step % 50 == 49:  # all events are at multiples of 50
                type(method).control_density(method, step)
        return calls

    return run


@pytest.mark.parametrize(
    ("name", "first", "interval", "last"),
    [
        ("3dgs", 600, 100, 14_900),
        ("clod", 600, 100, 14_900),
        ("lodge", 600, 300, 15_000),
        ("matryoshka", 600, 100, 14_900),
    ],
)
def test_steps_of_density_control(data, events, name, first, interval, last):
    method = create(name, data, method_info(name).preset("paper"), seed=0, backend="cpu")
    monitored = events(method)
    steps = list(range(first, last + 1, interval))
    assert monitored["densify"] == steps
    assert monitored.get("prune_oversized", []) == [step for step in steps if step > 3000 and name != "lodge"]
    assert monitored["prune"] == steps  # 3DGS program: densify_and_prune
    assert monitored["reset_opacities"] == [3000, 6000, 9000, 12_000]
    weighted = [8_000, 16_000, 24_000] if name == "lodge" else []  # LODGE, A.2
    assert monitored.get("prune_unimportant", []) == weighted


def test_steps_of_density_control_of_flod_levels(data, events):
    paper = method_info("flod").preset("paper")
    method = create("flod", data, paper, seed=0, backend="cpu")
    monitored = events(method)
    begin, expected = 0, {"densify": [], "prune": [], "reset_opacities": [], "well_separated": []}
    ends, intervals = (5_000, 6_000, 8_000, 10_000, 15_000), (2000, 1000, 500, 500, 200)
    for number, (steps, end, interval) in enumerate(zip(paper.steps, ends, intervals, strict=True), 1):
        assert (method.level_at(begin), method.level_at(begin + steps - 1)) == (number, number)
        for iteration in range(501, end):  # the programs: 500 < iteration < end
            for name, period in (("densify", interval), ("prune", 100), ("reset_opacities", 3000)):
                if iteration % period == 0:
                    expected[name].append(begin + iteration)
        if end != ends[-1]:  # Sec. 6.1.4: overlap pruning at all levels but the finest
            expected["well_separated"] += range(begin + 1000, begin + end, 1000)
        begin += steps
    assert monitored == expected


def test_no_reset_in_last_step_of_density_control(data):
    """Nothing removes splats that stay faint after it."""
    values = {"steps": 20, "densify_until": 0.5, "opacity_reset_interval": 5}
    parameters = replace(method_info("3dgs").preset("draft"), **values)
    method = create("3dgs", data, parameters, seed=0, backend="cpu")
    largest = []
    for step in range(12):
        method.train_step(step)
        largest.append(float(method.model.read("opacity_logits").sigmoid().max()))
    assert largest[4] == pytest.approx(0.01, abs=1e-4) and largest[9] > 0.011


def test_threshold_is_scaled_unless_disabled(data):
    for name in ("3dgs", "flod"):
        info = method_info(name)
        assert info.preset("draft").threshold_factor(data.threshold_scale) == np.sqrt(1e6 / (64 * 48))
        assert info.preset("paper").threshold_factor(data.threshold_scale) == 1


def test_unlimited_splats(data):
    """A limit of 0 keeps all points and lets all splats with gradients grow."""
    counts = {}
    for limit in (0, 70, 100_000):
        values = {"max_splats": limit, "densify_interval": 3, "grad_threshold": 0.0, "margin": 0.0}
        parameters = replace(method_info("3dgs").preset("draft"), **values, steps=10)
        method = create("3dgs", data, parameters, seed=0, backend="cpu")
        for step in range(4):
            method.train_step(step)
        counts[limit] = method.splats
    assert counts[0] == counts[100_000] > counts[70] > 0


@pytest.mark.parametrize(
    ("levels", "joins"),
    [
        (1, [0]),
        (2, [0, 0]),
        (3, [0, 0, 10_000]),
        (4, [0, 0, 0, 10_000]),
        (5, [0, 0, 0, 6_000, 10_000]),
        (6, [0, 0, 0, 0, 6_000, 10_000]),
        (8, [0, 0, 0, 0, 0, 4_737, 7_895, 10_000]),
    ],
)
def test_octree_levels_join_as_in_the_program(data, levels, joins):
    """Joins are a / (1 - q^n) (1 - q^i) with q = 1 / 1.5, n levels to join and a the end of the stage."""
    paper = replace(method_info("octree_neural").preset("paper"), levels=levels)
    schedule = create("octree_neural", data, paper, seed=0, backend="cpu").schedule
    assert schedule.join_steps == joins
    grows = [step + 1 for step in range(99, 40_000, 100) if schedule.grows_after(step)]
    assert grows == list(range(1_600, 25_000, 100))
    view = data.view(0)
    first = next(step for step in range(40_000) if schedule.collects_stats(view, step))
    assert first + 1 == 501, "program: iteration > start_stat"
    assert not schedule.prunes_unseen_after(39_999)


@pytest.mark.parametrize("name", ["octree", "octree_neural"])
def test_first_growth_of_octree_is_unlimited(data, name):
    """Octree-GS limits growth by gradients and free voxels alone."""
    paper = replace(method_info(name).preset("paper"), levels=6)
    counts = {}
    for key, room_exponent in (("paper", paper.room_exponent), ("reserved", 2.0)):
        method = create(name, data, replace(paper, room_exponent=room_exponent), seed=0, backend="cpu")
        means = method.model.read("means")[:1] + torch.arange(2000.0)[:, None] * torch.tensor([10.0, 0, 0])
        rows = {"means": means, "level": torch.ones(len(means), dtype=torch.uint8)}
        added = growing.limit_growth(method.schedule, method.model, rows, 1_599, 1500)
        counts[key] = len(added["means"])
    assert counts["paper"] > counts["reserved"] == 0, counts


@pytest.mark.parametrize(("init_level", "at_once"), [(0, 1), (2, 3), (4, 5), (11, 6)])
def test_octree_initial_level(data, init_level, at_once):
    """Octree-GS, Table 5: @2 and @4 count from level 0."""
    paper = replace(method_info("octree").preset("paper"), levels=6, init_level=init_level)
    joins = create("octree", data, paper, seed=0, backend="cpu").schedule.join_steps
    assert joins.count(0) == at_once and max(joins) == (10_000 if at_once < 6 else 0)


@pytest.mark.parametrize(
    ("name", "next_level", "bias", "initial"),
    [  # Octree-GS, Table 5; without progressive training all 6 levels start at once
        ("M1", False, False, 6), ("M2", False, True, 6), ("M3", True, True, 6), ("M4", True, False, 3),
        ("M5", True, True, 3), ("M6", True, False, 5), ("M7", True, True, 5),
    ],
)  # fmt: skip
def test_documented_ablations_of_octree_gs(data, name, next_level, bias, initial):
    [row] = [line for line in OCTREE_PAGE.read_text("utf-8").splitlines() if line.startswith(f"| {name}:")]
    settings = dict(item.split("=") for item in re.findall("`(.*?)`", row.split("|")[2]))
    values = {name: tomllib.loads(f"x = {text}")["x"] for name, text in settings.items()}
    p = override(method_info("octree").preset("paper"), values | {"levels": 6})
    assert (p.grow_next, p.bias_rate > 0) == (next_level, bias)
    joins = create("octree", data, p, seed=0, backend="cpu").schedule.join_steps
    assert joins.count(0) == initial


def test_coarse_stage_of_a_lod_of_gaussians_has_no_density_control(data, events):
    paper = replace(method_info("tree").preset("paper"), tune_steps=0)
    method = create("tree", data, paper, seed=0, backend="cpu")
    assert method.steps == 60_001 and method.finest_steps == 60_000
    assert events(method) == {}


def test_steps_of_the_tree(data, monkeypatch):
    """A LoD of Gaussians: density control every 1,000 steps, in 85 % of the steps on cuts."""
    method = create("tree", data, method_info("tree").preset("paper"), seed=0, backend="cpu")
    assert method.steps == 60_000 + 1 + 150_000
    method.store, grown = SimpleNamespace(cache=SimpleNamespace(end_step=lambda _: None)), []
    monkeypatch.setattr(method, "_rebuild_store", grown.append)
    for step in range(method.finest_steps + 100, method.steps, 100):
        method.control_density(step)
    assert grown == list(range(1000, 127_501, 1000))


def test_steps_of_lodge_levels(data, monkeypatch):
    """LODGE, A.2: a level is pruned three times, each time before 1,000 steps of tuning."""
    paper = replace(method_info("lodge").preset("paper"), steps=3)
    method = create("lodge", data, paper, seed=0, backend="cpu")
    begun, pruned = [], []
    monkeypatch.setattr(method, "_begin_level", begun.append)
    monkeypatch.setattr(method, "begin_round", pruned.append)
    for step in range(method.steps):
        method.begin_step(step)
    assert begun == [2, 1]
    assert pruned == [3, 1003, 2003, 3003, 4003, 5003] and method.steps == 6003


def test_decay_of_clod_gs_begins_at_step_5000(data):
    method = create("clod", data, method_info("clod").preset("paper"), seed=0, backend="cpu")
    assert method.decay_start == 5000  # CLoD-GS, Sec. 4.1


def test_learning_rates_of_flod_levels(data):
    """FLoD program: training_setup at each level, position_lr_max_steps = 30,000; 3DGS's rates otherwise."""
    paper = method_info("flod").preset("paper")
    method, begin = create("flod", data, paper, seed=0, backend="cpu"), 0
    for steps in paper.steps:
        for step in (0, 3000, steps - 1):
            method.set_learning_rates(begin + step)
            expected = 1.6e-4 * 0.01 ** (step / 30_000) * data.extent
            assert method.model.lr["means"] == pytest.approx(expected)
        begin += steps


@pytest.mark.parametrize(("step", "progress"), [(0, 0), (20_000, 0.5), (40_000, 1)])
def test_learning_rates_of_neural_anchors(data, step, progress):
    """Octree-GS program: rates of 40,000 iterations. The color network's ends at 5e-5 there."""
    method = create("octree_neural", data, method_info("octree_neural").preset("paper"), 0, "cpu")
    method.set_learning_rates(step)
    fall = 0.01**progress
    offsets = 0.01 * fall * data.extent
    constant = {"means": 0.0, "features": 0.0075, "log_scales": 0.007}
    assert method.model.adam.lr == pytest.approx(constant | {"offsets": offsets})
    rates = {"opacity": 0.002 * fall, "covariance": 0.004, "color": 0.008 * fall, "appearance": 0.05 * fall}
    optimizer = method.extra_optimizers[0]
    assert {name.split(".")[0]: optimizer.lr[name] for name in optimizer.tensors} == pytest.approx(rates)
