"""Properties of the training panel follow the declarations of methods."""

from dataclasses import dataclass

import pytest


@pytest.fixture
def object_with_method(bpy, lodgs, monkeypatch):
    """An object with the property group of a new method."""
    parameters, methods = lodgs("training.optimize.parameters"), lodgs("training.methods")
    setting = lodgs("training.settings").setting

    @dataclass(frozen=True)
    class NewParameters(parameters.Parameters):
        decay: float = setting(0.25, "Share that decays.", label="Faintness", high=1)
        width: float = setting(3.0, "Width.", above=0, unit="px")
        turns: int = setting(2, "Turns.", above=1, high=7)
        fast: bool = setting(True, "Train fast.")
        kind: str = setting("far_off", "Kind.", choices=("near", "far_off"))
        shares: tuple[float, ...] = setting((0.5, 0.5), "Shares.")

    offered = ("decay", "width", "turns", "fast", "kind", "shares")
    presets = {
        "draft": NewParameters(),
        "standard": NewParameters(width=4.5, kind="near"),
        "paper": NewParameters(),
    }
    info = methods.MethodInfo("new", 98, "New", "a method", NewParameters, presets, panel_parameters=offered)
    monkeypatch.setitem(methods.METHODS, "new", info)
    group = lodgs("data.training_settings")._parameters_of(info)
    bpy.utils.register_class(group)
    bpy.types.Object.new_method = bpy.props.PointerProperty(type=group)
    obj = bpy.data.objects.new("object", None)
    yield obj
    bpy.data.objects.remove(obj)
    del bpy.types.Object.new_method
    bpy.utils.unregister_class(group)


def test_new_method_has_properties(object_with_method):
    group, properties = object_with_method.new_method, object_with_method.new_method.bl_rna.properties
    names = [name for name in properties.keys() if name not in ("rna_type", "name")]  # noqa: SIM118
    assert names == [
        f"{kind}{name}"
        # lists of numbers have no property
        for name in ("decay", "width", "turns", "fast", "kind", "depth_weight", "depth")
        for kind in ("", "use_", "preset_")
    ]
    assert not any(properties[name].is_animatable for name in names)
    assert (properties["decay"].name, properties["decay"].description) == ("Faintness", "Share that decays")
    assert (properties["decay"].hard_min, properties["decay"].hard_max, properties["decay"].subtype) == (
        0,
        1,
        "FACTOR",
    )
    assert 0 < properties["width"].hard_min < 1e-5 and properties["width"].subtype == "PIXEL"
    assert (properties["turns"].hard_min, properties["turns"].hard_max) == (2, 7)
    object_with_method.lodgs.training.preset = "standard"
    values = [getattr(group, f"preset_{name}") for name in ("decay", "width", "turns", "fast", "kind")]
    assert values == [0.25, 4.5, 2, True, "near"]
    assert properties["preset_kind"].enum_items["near"].name == "Near", "panels show labels"


def test_override_starts_with_the_presets_value(object_with_method):
    group = object_with_method.new_method
    object_with_method.lodgs.training.preset = "standard"
    assert not group.use_width and not group.use_kind
    group.use_width = group.use_kind = True
    assert (group.width, group.kind, group.use_decay) == (4.5, "near", False)
    group.width = 6
    group.use_width = True  # without effect
    assert group.width == 6
    group.use_width = False
    group.use_width = True
    assert group.width == 4.5
    group.turns = 5  # setting a value enables the override
    assert group.use_turns


def test_every_method_has_a_group(bpy, lodgs):
    settings = bpy.data.objects.new("root", None).lodgs.training
    for name, info in lodgs("training.methods").METHODS.items():
        settings.method = name
        for preset in lodgs("training.methods").PRESETS:
            settings.preset = preset
            values = {name: getattr(settings.parameters, f"preset_{name}") for name in info.panel_parameters}
            expected = {name: getattr(info.preset(preset), name) for name in info.panel_parameters}
            assert values == pytest.approx(expected)  # Blender's numbers are float32


@pytest.fixture
def scene_with_photos(bpy):
    """``scene_with_photos(40)``: return the root of a scene with this number of photos."""

    def make(count):
        root = bpy.data.objects.new("root", None)
        root.lodgs.is_root, root.lodgs.cameras = True, bpy.data.collections.new("cameras")
        for number in range(count):
            camera = bpy.data.cameras.new(f"{number}")
            root.lodgs.cameras.objects.link(bpy.data.objects.new(f"{number}", camera))
        return root

    return make


@pytest.mark.parametrize(("count", "interval"), [(0, 0), (2, 0), (39, 0), (40, 8), (48, 8)])
def test_photos_are_held_out_if_there_are_enough(lodgs, scene_with_photos, count, interval):
    root, training = scene_with_photos(count), lodgs("data.training_settings")
    settings = root.lodgs.training
    assert (
        training.hold_out_interval(root) == settings.preset_test_every == interval
        and not settings.use_test_every
    )
    settings.use_test_every = True
    assert training.hold_out_interval(root) == settings.test_every == interval
    for value in (5, 0):
        settings.test_every = value
        assert training.hold_out_interval(root) == value and settings.preset_test_every == interval
    settings.use_test_every = False
    assert training.hold_out_interval(root) == interval


def test_held_out_views_follow_the_job(lodgs, scene_with_photos, tmp_path):
    root = scene_with_photos(40)
    job_settings = lodgs("runs.job_settings")
    root.lodgs.scene_folder = str(tmp_path)
    assert job_settings.make_job(root, tmp_path, {}).test_every == 8
    cameras = root.lodgs.cameras.objects
    cameras.unlink(cameras[0])
    assert job_settings.make_job(root, tmp_path, {}).test_every == 0
    root.lodgs.training.test_every = 4
    assert job_settings.make_job(root, tmp_path, {}).test_every == 4


def test_image_scale_follows_the_preset_until_it_is_changed(object_with_method):
    settings = object_with_method.lodgs.training
    scales = []
    for preset in ("paper", "draft", "paper"):
        settings.preset = preset
        scales.append(settings.image_scale)
    assert scales == [1, 0.5, 1]
    settings.image_scale = 0.25
    settings.preset = "standard"
    assert settings.image_scale == 0.25
