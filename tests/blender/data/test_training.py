"""The training panel's properties come from what methods declare."""

from dataclasses import dataclass

import pytest


@pytest.fixture
def made_up(bpy, lodgs, monkeypatch):
    """The group of a method that nobody knew, on an object."""
    parameters, methods = lodgs("training.optimize.parameters"), lodgs("training.methods")
    setting = lodgs("training.settings").setting

    @dataclass(frozen=True)
    class Made(parameters.Parameters):
        decay: float = setting(0.25, "Share that decays.", label="Faintness", high=1)
        width: float = setting(3.0, "Width.", above=0, unit="px")
        turns: int = setting(2, "Turns.", above=1, high=7)
        fast: bool = setting(True, "Whether it hurries.")
        kind: str = setting("far_off", "Kind.", choices=("near", "far_off"))
        shares: tuple[float, ...] = setting((0.5, 0.5), "Shares.")

    offered = ("decay", "width", "turns", "fast", "kind", "shares")
    presets = {"draft": Made(), "standard": Made(width=4.5, kind="near"), "paper": Made()}
    info = methods.MethodInfo("made", 98, "Made", "up", Made, presets, panel_parameters=offered)
    monkeypatch.setitem(methods.METHODS, "made", info)
    group = lodgs("data.training")._parameters_of(info)
    bpy.utils.register_class(group)
    bpy.types.Object.made = bpy.props.PointerProperty(type=group)
    obj = bpy.data.objects.new("made", None)
    yield obj
    bpy.data.objects.remove(obj)
    del bpy.types.Object.made
    bpy.utils.unregister_class(group)


def test_a_method_that_is_added_brings_its_parameters(made_up):
    group, known = made_up.made, made_up.made.bl_rna.properties
    names = [name for name in known.keys() if name not in ("rna_type", "name")]  # noqa: SIM118
    assert names == [
        f"{kind}{name}"
        for name in (  # one number for each level has no place
            "decay",
            "width",
            "turns",
            "fast",
            "kind",
            "depth_weight",
            "depth",
        )
        for kind in ("", "use_", "preset_")
    ]
    assert not any(known[name].is_animatable for name in names)
    assert (known["decay"].name, known["decay"].description) == ("Faintness", "Share that decays")
    assert (known["decay"].hard_min, known["decay"].hard_max, known["decay"].subtype) == (0, 1, "FACTOR")
    assert 0 < known["width"].hard_min < 1e-5 and known["width"].subtype == "PIXEL"
    assert (known["turns"].hard_min, known["turns"].hard_max) == (2, 7)
    made_up.lodgs.training.preset = "standard"
    shown = [getattr(group, f"preset_{name}") for name in ("decay", "width", "turns", "fast", "kind")]
    assert shown == [0.25, 4.5, 2, True, "near"]


def test_ticking_begins_with_the_presets_value_and_unticking_forgets(made_up):
    group = made_up.made
    made_up.lodgs.training.preset = "standard"
    assert not group.use_width and not group.use_kind
    group.use_width = group.use_kind = True
    assert (group.width, group.kind, group.use_decay) == (4.5, "near", False)
    group.width = 6
    group.use_width = True  # it is
    assert group.width == 6
    group.use_width = False
    group.use_width = True
    assert group.width == 4.5
    group.turns = 5  # a script's value counts without a tick
    assert group.use_turns


def test_every_method_has_a_group(bpy, lodgs):
    settings = bpy.data.objects.new("root", None).lodgs.training
    for name, info in lodgs("training.methods").METHODS.items():
        settings.method = name
        for preset in lodgs("training.methods").PRESETS:
            settings.preset = preset
            shown = {name: getattr(settings.parameters, f"preset_{name}") for name in info.panel_parameters}
            wanted = {name: getattr(info.preset(preset), name) for name in info.panel_parameters}
            assert shown == pytest.approx(wanted)  # Blender's numbers are float32


@pytest.fixture
def photographed(bpy):
    """``photographed(40)``: a scene root with so many photographs."""

    def make(count):
        root = bpy.data.objects.new("root", None)
        root.lodgs.is_root, root.lodgs.cameras = True, bpy.data.collections.new("cameras")
        for number in range(count):
            camera = bpy.data.cameras.new(f"{number}")
            root.lodgs.cameras.objects.link(bpy.data.objects.new(f"{number}", camera))
        return root

    return make


@pytest.mark.parametrize(("count", "every"), [(0, 0), (2, 0), (39, 0), (40, 8), (48, 8)])
def test_photographs_are_held_out_where_there_are_enough(lodgs, photographed, count, every):
    root, training = photographed(count), lodgs("data.training")
    settings = root.lodgs.training
    assert (
        training.hold_out_interval(root) == settings.preset_test_every == every
        and not settings.use_test_every
    )
    settings.use_test_every = True
    assert training.hold_out_interval(root) == settings.test_every == every
    for own in (5, 0):
        settings.test_every = own
        assert training.hold_out_interval(root) == own and settings.preset_test_every == every
    settings.use_test_every = False
    assert training.hold_out_interval(root) == every


def test_held_out_views_follow_the_job(lodgs, photographed, tmp_path):
    root = photographed(40)
    job_settings = lodgs("runs.job_settings")
    root.lodgs.scene_folder = str(tmp_path)
    assert job_settings.make_job(root, tmp_path, {}).test_every == 8
    cameras = root.lodgs.cameras.objects
    cameras.unlink(cameras[0])
    assert job_settings.make_job(root, tmp_path, {}).test_every == 0
    root.lodgs.training.test_every = 4
    assert job_settings.make_job(root, tmp_path, {}).test_every == 4
