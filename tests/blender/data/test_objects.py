"""Splats round trip through point clouds: unchanged values to the bit, and edits by artists."""

import tracemalloc

import numpy as np
import pytest


@pytest.fixture
def make(lodgs):
    def make(count: int, degree: int = 3, seed: int = 0, **extras):
        rng = np.random.default_rng(seed)

        def normal(*shape, spread=1.0):
            return (spread * rng.standard_normal(shape)).astype(np.float32)

        return lodgs("training.splats.gaussians").Splats(
            means=normal(count, 3, spread=3),
            quats=normal(count, 4),  # not normalized, as in files
            log_scales=normal(count, 3, spread=2) - 2,
            opacity_logits=normal(count, spread=4),
            sh=normal(count, (degree + 1) ** 2, 3),
            extras=extras,
        )

    return make


def same_bits(a, b) -> bool:
    fields = ("means", "quats", "log_scales", "opacity_logits", "sh")
    pairs = [(getattr(a, name), getattr(b, name)) for name in fields]
    pairs += [(a.extras[name], b.extras[name]) for name in a.extras]
    return list(a.extras) == list(b.extras) and all(
        x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes() for x, y in pairs
    )


@pytest.mark.parametrize("degree", range(5))
def test_round_trip_is_bit_exact(lodgs, make, degree):
    objects = lodgs("data.objects")
    rng = np.random.default_rng(1)
    splats = make(
        500,
        degree,
        sigma=rng.random(500, np.float32),
        scale=rng.random(500, np.float32),  # point clouds have another attribute of this name
        label=rng.integers(0, 255, 500).astype(np.uint8),
        key=rng.integers(0, 2**32, 500).astype(np.uint32),
        time=rng.random(500),
    )
    splats.log_scales[:100] *= 4
    splats.opacity_logits[:100] *= 10  # sigmoid saturates
    obj = objects.new_splats("s", splats)
    assert same_bits(splats, objects.read_splats(obj))


def test_bounds_are_those_of_the_points(bpy, lodgs, make):
    splats = make(50)
    points = lodgs("data.objects").new_points("points", splats.means, np.zeros((50, 3), np.uint8), 0.0)
    for obj in (points, lodgs("data.objects").new_splats("splats", splats)):
        bpy.context.scene.collection.objects.link(obj)
        bpy.context.view_layer.update()
        center = np.mean(obj.bound_box, axis=0)
        expected = (splats.means.min(axis=0) + splats.means.max(axis=0)) / 2
        np.testing.assert_allclose(center, expected, atol=0.2)  # splats have a radius


def test_round_trip_of_no_splats_and_of_one(lodgs, make):
    objects = lodgs("data.objects")
    for count in (0, 1):
        splats = make(count, 1)
        assert same_bits(splats, objects.read_splats(objects.new_splats("s", splats)))


def test_attributes_match_native_splats(lodgs, make):
    objects, attributes, splats = lodgs("data.objects"), lodgs("attributes"), make(50, 2)
    cloud = objects.new_splats("s", splats).data
    base = attributes.read_attribute(cloud, "radiance:base")
    assert np.array_equal(base[:, :3], splats.sh[:, 0])
    assert base[:, 3] == pytest.approx(1 / (1 + np.exp(-splats.opacity_logits.astype(float))), abs=1e-6)
    for k in range(1, 9):
        assert np.array_equal(attributes.read_attribute(cloud, f"radiance:sh_{k - 1}"), splats.sh[:, k])
    assert "radiance:sh_8" not in cloud.attributes
    scale = attributes.read_attribute(cloud, "scale")
    assert scale == pytest.approx(np.exp(splats.log_scales.astype(float)), rel=1e-6)
    rotation = attributes.read_attribute(cloud, "rotation")
    quats = splats.quats.astype(float)
    assert rotation == pytest.approx(quats / np.linalg.norm(quats, axis=1, keepdims=True), abs=1e-6)
    assert cloud.attributes["rotation"].data_type == "QUATERNION"


def test_display_colour_matches_sh(lodgs, make):
    objects, attributes, splats = lodgs("data.objects"), lodgs("attributes"), make(50, 0)
    obj = objects.new_splats("s", splats)
    linear = attributes.read_attribute(obj.data, "display_color")[:, :3].astype(float)
    srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    truth = np.clip(0.5 + splats.sh[:, 0] / (2 * np.sqrt(np.pi)), 0, 1)
    assert srgb == pytest.approx(truth, abs=0.5 / 255 + 1e-4)
    assert tuple(obj.color[:3]) == pytest.approx(linear.mean(axis=0), abs=1e-5)


def test_edits_take_precedence(lodgs, make):
    objects, attributes, splats = lodgs("data.objects"), lodgs("attributes"), make(40, 1)
    obj = objects.new_splats("s", splats)
    cloud = obj.data
    scale = attributes.read_attribute(cloud, "scale")
    scale[:10] *= 2
    attributes.write_attribute(cloud, "scale", "FLOAT_VECTOR", scale)
    base = attributes.read_attribute(cloud, "radiance:base")
    base[20:, 3] = 0.25
    attributes.write_attribute(cloud, "radiance:base", cloud.attributes["radiance:base"].data_type, base)

    edited = objects.read_splats(obj)
    expected = splats.log_scales[:10].astype(float) + np.log(2)
    assert edited.log_scales[:10] == pytest.approx(expected, abs=1e-5)
    assert np.array_equal(edited.log_scales[10:], splats.log_scales[10:])
    assert np.array_equal(edited.opacity_logits[:20], splats.opacity_logits[:20])
    assert edited.opacity_logits[20:] == pytest.approx(np.log(0.25 / 0.75), abs=1e-6)
    assert np.array_equal(edited.quats, splats.quats)


@pytest.mark.parametrize("kind", ["FLOAT", "FLOAT_COLOR", "INT32_2D", "FLOAT4X4"])
@pytest.mark.parametrize("name", ["radiance:sh_2", "radiance:base", "scale"])
def test_attribute_of_another_type_is_named(lodgs, make, kind, name):
    if (kind, name) == ("FLOAT_COLOR", "radiance:base"):
        pytest.skip("that is its own type")
    objects, obj = lodgs("data.objects"), lodgs("data.objects").new_splats("s", make(5, 1))
    obj.data.attributes.remove(obj.data.attributes[name])
    obj.data.attributes.new(name, kind, "POINT")
    with pytest.raises(lodgs("training.errors").LodgsError, match=rf"'s': it.* (attribute {name}|no splats)"):
        objects.read_splats(obj)
    assert len(lodgs("attributes").sh_names(obj.data)) == (0 if name == "radiance:sh_2" else 3)


def test_points_deleted_by_a_modifier_are_not_read(bpy, lodgs, make):
    """The remaining splats are unchanged to the bit."""
    objects, splats = lodgs("data.objects"), make(60, 1, label=np.arange(60, dtype=np.uint8))
    obj = objects.new_splats("s", splats)
    bpy.context.scene.collection.objects.link(obj)
    group = bpy.data.node_groups.new("crop", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    nodes = [
        group.nodes.new(kind) for kind in ("NodeGroupInput", "GeometryNodeDeleteGeometry", "NodeGroupOutput")
    ]
    index, less = group.nodes.new("GeometryNodeInputIndex"), group.nodes.new("FunctionNodeCompare")
    less.data_type, less.operation = "INT", "LESS_THAN"
    a, b = [socket for socket in less.inputs if socket.enabled][:2]
    b.default_value = 25
    group.links.new(index.outputs[0], a)
    group.links.new(less.outputs[0], nodes[1].inputs["Selection"])
    group.links.new(nodes[0].outputs[0], nodes[1].inputs["Geometry"])
    group.links.new(nodes[1].outputs[0], nodes[2].inputs[0])
    obj.modifiers.new("crop", "NODES").node_group = group
    remaining = objects.read_splats(obj, bpy.context.evaluated_depsgraph_get())
    assert same_bits(splats.select(slice(25, None)), remaining)


def test_object_without_splats_is_rejected(lodgs):
    objects = lodgs("data.objects")
    obj = objects.new_points("p", np.zeros((3, 3)), np.zeros((3, 3), np.uint8), 0.1)
    with pytest.raises(lodgs("training.errors").LodgsError, match="no splats"):
        objects.read_splats(obj)


def test_megabytes_match_the_file(bpy, lodgs, make, tmp_path):
    splats = make(2000, 3)
    lodgs("training.splats.ply").write_ply(tmp_path / "a.ply", splats)
    size = (tmp_path / "a.ply").stat().st_size / 1e6
    assert lodgs("data.objects").megabytes(
        lodgs("data.objects").new_splats("s", splats).data
    ) == pytest.approx(size, rel=0.01)


def test_memory_of_new_splats_is_that_of_their_attributes(bpy, lodgs, make, monkeypatch):
    """Temporary arrays do not add to complete attributes: SH coefficients come last."""
    objects, splats = lodgs("data.objects"), make(20_000, 3)
    written, largest = 0, 0

    def write_attribute(cloud, name, kind, values):
        nonlocal written, largest
        layout = lodgs("attributes").LAYOUTS[kind]
        attributes.write_attribute(cloud, name, kind, values)
        largest = max(largest, written + tracemalloc.get_traced_memory()[1])
        written += np.dtype(layout.dtype).itemsize * layout.width * len(values)
        tracemalloc.reset_peak()

    attributes = lodgs("attributes")
    monkeypatch.setattr(objects, "write_attribute", write_attribute)
    tracemalloc.start()
    try:
        objects.new_splats("splats", splats)
    finally:
        tracemalloc.stop()
    assert largest < 1.02 * written
