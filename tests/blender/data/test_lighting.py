"""Light of lamps and worlds at a point, and the tint of splats by it."""

import numpy as np
import pytest

from tests.blender.fake_trainer import splats
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level


@pytest.fixture
def scene(bpy, tmp_path):
    write_bundle(tmp_path / "b.ply", Bundle("flod", [Level(1, splats(5))]))
    assert bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "b.ply"), upright=False) == {"FINISHED"}
    return bpy.context.scene


def add_lamp(bpy, kind, color, energy, location=(0, 0, 0)):
    lamp = bpy.data.lights.new(kind, kind)
    lamp.color, lamp.energy = color, energy
    obj = bpy.data.objects.new(kind, lamp)
    obj.location = location
    bpy.context.scene.collection.objects.link(obj)
    return obj


def light(bpy, lodgs, position=(0, 0, 0)):
    from mathutils import Vector

    depsgraph = bpy.context.evaluated_depsgraph_get()
    return lodgs("data.lighting").mean_light(bpy.context.scene, depsgraph, Vector(position))


@pytest.mark.parametrize(
    ("kind", "energy", "location", "expected"),
    [
        ("SUN", 4.0, (0, 0, 0), 4.0),
        ("POINT", 400 * np.pi, (0, 0, 5), 4.0),  # flux over a sphere of radius 5
        ("SPOT", 400 * np.pi, (0, 0, 5), 4.0),  # the intensity of a point lamp
        ("SPOT", 400 * np.pi, (0, 0, -5), 0.0),  # shines downwards, away from the origin
        ("AREA", 100 * np.pi, (0, 0, 5), 4.0),  # Lambert: radiance flux / (pi area)
        ("AREA", 100 * np.pi, (0, 0, -5), 0.0),
    ],
)
def test_lamps_give_their_irradiance(bpy, lodgs, scene, kind, energy, location, expected):
    add_lamp(bpy, kind, (1, 0.5, 0.25), energy, location)
    np.testing.assert_allclose(light(bpy, lodgs), np.array([1, 0.5, 0.25]) * expected / 4, rtol=1e-5)


@pytest.mark.parametrize(
    ("kind", "settings", "area"),
    [
        ("AREA", {"shape": "RECTANGLE", "size": 0.1, "size_y": 0.2}, 0.12),
        ("AREA", {"shape": "ELLIPSE", "size": 0.1, "size_y": 0.2}, 0.12 * np.pi / 4),
        ("POINT", {"shadow_soft_size": 0.1}, 0.04 * np.pi),
        ("POINT", {"shadow_soft_size": 0}, 4),
        ("SUN", {"angle": 0.3}, np.pi * np.sin(0.15) ** 2),
        ("SUN", {"angle": 0}, 1),
    ],
)
def test_lamps_without_normalize_grow_brighter_with_their_size(bpy, lodgs, scene, kind, settings, area):
    """The factors are those of renders of Cycles."""
    obj = add_lamp(bpy, kind, (1, 1, 1), 100, (0, 0, 5))
    if not hasattr(obj.data, "normalize"):
        pytest.skip("Blender before 4.5 normalises all lamps")
    for name, value in settings.items():
        setattr(obj.data, name, value)
    obj.scale = (2, 3, 1)
    bpy.context.view_layer.update()
    normalized = light(bpy, lodgs)
    obj.data.normalize = False
    bpy.context.view_layer.update()
    np.testing.assert_allclose(light(bpy, lodgs), normalized * area, rtol=1e-5)


def test_temperature_colours_a_lamp(bpy, lodgs, scene):
    lamp = add_lamp(bpy, "SUN", (1, 1, 0.5), 4.0).data
    lamp.use_temperature, lamp.temperature = True, 2700
    red, green, blue = light(bpy, lodgs)
    assert red > 2 * green > 4 * blue > 0  # the colour of an incandescent lamp


def test_environment_image_counts_by_solid_angle(bpy, lodgs, scene):
    """The rows below a latitude of 30 degrees cover three quarters of the sphere."""
    image = bpy.data.images.new("sky", 64, 96, float_buffer=True)
    pixels = np.zeros((96, 64, 4), np.float32)
    pixels[:64, :, 2], pixels[64:, :, 0] = 1, 1
    image.pixels.foreach_set(pixels.reshape(-1))
    world = scene.world = bpy.data.worlds.new("world")
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    background, environment = (nodes.new(f"ShaderNode{kind}") for kind in ("Background", "TexEnvironment"))
    background.inputs["Strength"].default_value = 2.0
    environment.image = image
    links.new(environment.outputs["Color"], background.inputs["Color"])
    np.testing.assert_allclose(light(bpy, lodgs), 2 * np.pi * np.array([0.25, 0, 0.75]), atol=0.02)
    assert list(image.size) == [64, 96]


def test_tint_is_the_display_colour_of_the_light(bpy, lodgs, scene):
    [root] = lodgs("data.roots").roots(scene)
    with pytest.raises(RuntimeError, match="no light"):
        bpy.ops.lodgs.tint_by_light()
    add_lamp(bpy, "SUN", (0.25, 0.5, 1.0), 3.0)
    assert bpy.ops.lodgs.tint_by_light() == {"FINISHED"}
    expected = np.array([0.25, 0.5, 1.0]) ** (1 / 2.2)
    np.testing.assert_allclose(root.lodgs_look.tint, expected, rtol=1e-5)
    np.testing.assert_allclose(
        np.diag(lodgs("data.looks")._read_look(root.lodgs_look).matrix), expected, 1e-4
    )
    bpy.ops.lodgs.add_crop(shape="SPHERE", keep="ALL")
    region = bpy.context.active_object
    assert bpy.ops.lodgs.tint_by_light(name=region.name) == {"FINISHED"}
    np.testing.assert_allclose(region.lodgs_look.tint, expected, rtol=1e-5)
    with pytest.raises(RuntimeError, match=r"Cannot tint look.*no crop"):
        bpy.ops.lodgs.tint_by_light(name="none")
