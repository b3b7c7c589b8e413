"""Model and render the lantern garden with the bpy module and Cycles on the CPU.

    python -m examples.build_scene build/example          88 views, about twenty minutes on two cores

Writes images/view_NN.png, positions/view_NN.exr (world positions of visible surfaces) for every set of
cameras in rig.py, and garden.blend; write_model.py converts them to photos and COLMAP models. Lengths are in
metres, z is up, the table is at the origin, and the arcs of cameras face north (+y).
"""

# Blender's stubs type nodes, sockets, modifiers and object data by their base classes.

from __future__ import annotations

import argparse
import itertools
import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from . import rig

rng = np.random.default_rng(7)
TABLE = 0.78  # height of the table top
MILL = (6.0, 29.0)  # position of the windmill


# ------------------------------------------------------------------------------------------- materials


def linear(color: str | tuple) -> tuple[float, float, float, float]:
    """Convert '#rrggbb' to linear RGBA."""
    if isinstance(color, tuple):
        return color
    srgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    value = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return (*value.tolist(), 1.0)


def material(
    name: str,
    colors: list[str],
    *,
    pattern: str = "noise",
    scale: float = 8.0,
    stretch: tuple = (1, 1, 1),
    distortion: float = 0.0,
    bump: float = 0.2,
    vary: float = 0.0,
    glow: float = 0.0,
    attribute: str | None = None,
) -> bpy.types.Material:
    """Create a matte material: a procedural pattern with a colour ramp.

    Args:
        name: name of the material.
        colors: stops of the ramp.
        pattern: noise, rings, bands or cells.
        scale, stretch, distortion, bump: parameters of the pattern.
        vary: random variation of brightness and hue per object.
        glow: emission strength.
        attribute: name of vertex colours to multiply by the pattern.
    """
    result = bpy.data.materials.new(name)
    result.use_nodes = True
    tree = result.node_tree
    nodes, links = tree.nodes, tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = 0.9
    surface.inputs["Specular IOR Level"].default_value = 0.15

    coordinates = nodes.new("ShaderNodeTexCoord")
    mapping = nodes.new("ShaderNodeMapping")
    mapping.inputs["Scale"].default_value = stretch
    links.new(coordinates.outputs["Object"], mapping.inputs["Vector"])
    if pattern == "noise":
        texture = nodes.new("ShaderNodeTexNoise")
        texture.inputs["Detail"].default_value = 3.0
        texture.inputs["Distortion"].default_value = distortion
        value = texture.outputs["Fac"]
    elif pattern == "cells":
        texture = nodes.new("ShaderNodeTexVoronoi")
        value = texture.outputs["Distance"]
    else:
        texture = nodes.new("ShaderNodeTexWave")
        texture.wave_type = "RINGS" if pattern == "rings" else "BANDS"
        texture.inputs["Distortion"].default_value = distortion
        texture.inputs["Detail"].default_value = 2.0
        texture.inputs["Detail Scale"].default_value = 1.5
        value = texture.outputs["Fac"]
    texture.inputs["Scale"].default_value = scale
    links.new(mapping.outputs["Vector"], texture.inputs["Vector"])

    ramp = nodes.new("ShaderNodeValToRGB")
    low, high = (0.3, 0.7) if pattern == "noise" else (0.0, 1.0)
    stops = ramp.color_ramp.elements
    while len(stops) < len(colors):
        stops.new(0.5)
    for index in range(len(colors)):
        stops[index].position = low + (high - low) * index / max(len(colors) - 1, 1)
    for index, color in enumerate(colors):
        stops[index].color = linear(color)
    links.new(value, ramp.inputs["Fac"])
    color = ramp.outputs["Color"]

    if attribute:
        painted = nodes.new("ShaderNodeVertexColor")
        painted.layer_name = attribute
        multiply = nodes.new("ShaderNodeMix")
        multiply.data_type, multiply.blend_type = "RGBA", "MULTIPLY"
        multiply.inputs["Factor"].default_value = 1.0
        links.new(color, multiply.inputs["A"])
        links.new(painted.outputs["Color"], multiply.inputs["B"])
        color = multiply.outputs["Result"]
    if vary:
        info = nodes.new("ShaderNodeObjectInfo")
        shift = nodes.new("ShaderNodeHueSaturation")
        for socket, low, high in (("Value", 1 - vary, 1 + vary), ("Hue", 0.5 - vary / 8, 0.5 + vary / 8)):
            span = nodes.new("ShaderNodeMapRange")
            span.inputs["To Min"].default_value, span.inputs["To Max"].default_value = low, high
            links.new(info.outputs["Random"], span.inputs["Value"])
            links.new(span.outputs["Result"], shift.inputs[socket])
        links.new(color, shift.inputs["Color"])
        color = shift.outputs["Color"]
    links.new(color, surface.inputs["Base Color"])
    result.cycles.emission_sampling = "NONE"  # visible glow, little light
    if glow:
        links.new(color, surface.inputs["Emission Color"])
        surface.inputs["Emission Strength"].default_value = glow
    if bump:
        relief = nodes.new("ShaderNodeBump")
        relief.inputs["Strength"].default_value = bump
        relief.inputs["Distance"].default_value = 0.02
        links.new(value, relief.inputs["Height"])
        links.new(relief.outputs["Normal"], surface.inputs["Normal"])
    return result


# ---------------------------------------------------------------------------------------------- meshes


def mesh(name, vertices, faces, mat, *, at=(0, 0, 0), turn=0.0, smooth=True, colors=None):
    """Create an object from vertices (N, 3), faces and optional vertex colours (N, 3)."""
    data = bpy.data.meshes.new(name)
    data.from_pydata(np.asarray(vertices, float).tolist(), [], [list(face) for face in faces])
    if smooth:
        data.shade_smooth()
    data.materials.append(mat)
    if colors is not None:
        layer = data.color_attributes.new("paint", "FLOAT_COLOR", "POINT")
        rgba = np.concatenate([colors, np.ones((len(colors), 1))], axis=1).astype(np.float32)
        layer.data.foreach_set("color", rgba.ravel())
    return add_object(data, at, turn)


def add_object(data, at, turn=0.0, scale=1.0, tilt=(0.0, 0.0)):
    """Add an object with a mesh, rotated about z (radians), scaled, and tilted about x and y."""
    obj = bpy.data.objects.new(data.name, data)
    obj.location, obj.rotation_euler = at, (tilt[0], tilt[1], turn)
    obj.scale = (scale,) * 3 if np.isscalar(scale) else scale
    bpy.context.scene.collection.objects.link(obj)
    return obj


def wobble(points, seed, frequency, octaves=3, ridged=False):
    """Return smooth fractal noise (N,) in about [-1, 1] for points (N, D): sines in random directions."""
    source = np.random.default_rng(seed)
    total, weight = np.zeros(len(points)), 0.0
    for octave in range(octaves):
        directions = source.normal(size=(points.shape[1], 5)) * frequency * 2.0**octave
        layer = np.sin(points @ directions + source.uniform(0, 6.3, 5)).mean(axis=1) * 1.6
        total += (1 - 2 * np.abs(layer) if ridged else layer) * 0.5**octave
        weight += 0.5**octave
    return total / weight


def box(name, size, mat, *, at=(0, 0, 0), turn=0.0, bevel=0.008, tilt=(0.0, 0.0)):
    """Create a box around its centre, with slightly rounded edges."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(size) / 2
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    obj = mesh(name, corners, faces, mat, at=at, turn=turn, smooth=False)
    obj.rotation_euler = (tilt[0], tilt[1], turn)
    if bevel:
        rounded = obj.modifiers.new("Bevel", "BEVEL")
        rounded.width, rounded.segments = bevel, 2
    return obj


def lathe(name, profile, mat, *, at=(0, 0, 0), segments=40, turn=0.0, ribs=0, depth=0.0):
    """Create a surface of revolution from a profile of (radius, height), with optional grooves."""
    profile = np.array(profile, float)
    angle = np.linspace(0, 2 * math.pi, segments, endpoint=False)
    swell = 1 + depth * (np.abs(np.cos(ribs * angle / 2)) - 1) if ribs else np.ones(segments)
    radius = profile[:, None, 0] * swell
    height = np.broadcast_to(profile[:, None, 1], radius.shape)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2).reshape(-1, 3)
    return mesh(name, vertices, grid_faces(len(profile), segments, closed=True), mat, at=at, turn=turn)


def grid_faces(rows, columns, closed=False):
    """Return the quads of a grid of vertices in row order; ``closed`` joins the last and first columns."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - (0 if closed else 1)), indexing="ij")
    following = (column + 1) % columns
    quads = [row * columns + column, row * columns + following]
    quads += [(row + 1) * columns + following, (row + 1) * columns + column]
    return np.stack(quads, axis=-1).reshape(-1, 4).tolist()


def smooth_profile(points, count=24):
    """Interpolate a profile through control points (Catmull-Rom)."""
    points = np.array(points, float)
    padded = np.concatenate([points[:1], points, points[-1:]])
    t = np.linspace(0, len(points) - 1 - 1e-9, count)
    i, u = t.astype(int), (t % 1)[:, None]
    a, b, c, d = (padded[i + k] for k in range(4))
    curve = 0.5 * (2 * b + (c - a) * u + (2 * a - 5 * b + 4 * c - d) * u**2 + (3 * b - a - 3 * c + d) * u**3)
    return np.maximum(curve, [[0.0, -np.inf]]).tolist()


def ball(name, radius, mat, *, at=(0, 0, 0), rough=0.0, frequency=6.0, seed=0, squash=1.0, detail=4):
    """Create a sphere of small triangles with a surface roughened by noise."""
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=detail, radius=1.0)
    obj = bpy.context.object
    data = obj.data
    data.name = name
    points = np.empty((len(data.vertices), 3), np.float32)
    data.vertices.foreach_get("co", points.ravel())
    points *= (
        (1 + rough * wobble(points, seed, frequency))[:, None] * radius * np.array([1, 1, squash], np.float32)
    )
    data.vertices.foreach_set("co", points.ravel())
    data.shade_smooth()
    data.materials.append(mat)
    obj.location = at
    return obj


def scatter(name, points, mat, *, blades, height, width, colors, lean=0.5, seed=0):
    """Create tufts of bent blades (grass, reeds, petals) at points (N, 3); height and width in metres."""
    source = np.random.default_rng(seed)
    base = np.repeat(points, blades, axis=0)
    count = len(base)
    spread = source.normal(size=(count, 2)) * width * 3
    base = base + np.pad(spread, ((0, 0), (0, 1)))
    angle = source.uniform(0, 2 * math.pi, count)
    side = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], 1) * width / 2
    tall = (height * source.uniform(0.5, 1.3, count))[:, None]
    out = np.stack([-np.sin(angle), np.cos(angle), np.zeros(count)], 1) * tall * lean
    out *= source.uniform(0.2, 1.0, count)[:, None]
    up = np.array([0, 0, 1.0]) * tall
    middle, tip = base + 0.55 * up + 0.3 * out, base + up * 0.95 + out
    vertices = np.stack([base - side, base + side, middle - side * 0.8, middle + side * 0.8, tip], axis=1)
    first = 5 * np.arange(count)[:, None]
    faces = np.add(first, [0, 1, 3, 2]).tolist() + np.add(first, [2, 3, 4]).tolist()
    palette = np.array([linear(color)[:3] for color in colors])
    chosen = palette[source.integers(len(palette), size=count)] * source.uniform(0.9, 1.5, (count, 1))
    shade = np.array([0.55, 0.55, 0.9, 0.9, 1.15])  # darker at the root
    paint = (chosen[:, None] * shade[None, :, None]).reshape(-1, 3)
    return mesh(name, vertices.reshape(-1, 3), faces, mat, colors=paint)


# ------------------------------------------------------------------------------------------------ land


def path_x(y):
    """Return the path's x coordinate at y."""
    return 0.9 * np.sin(0.33 * y) * np.clip(y / 4, 0, 1) + 0.05 * y


def ground(x, y):
    """Return the height of the land: a level garden, meadows, hills and mountains."""
    distance = np.hypot(x, y)
    points = np.stack([x, y], axis=-1).reshape(-1, 2)
    swell = wobble(points, 1, 0.12, 3).reshape(x.shape)
    small = wobble(points, 2, 0.9, 3).reshape(x.shape)
    ridge = wobble(points, 9, 0.07, 5, ridged=True).reshape(x.shape)
    rise = np.clip((distance - 7) / 24, 0, 1)
    height = 0.03 * small + rise * (0.9 + 1.5 * swell)
    height += 2.3 * np.exp(-((x - MILL[0]) ** 2 + (y - MILL[1]) ** 2) / 40)  # the windmill's hill
    height += 1.0 * np.exp(-((x + 11) ** 2 + (y - 19) ** 2) / 60)
    mountains = np.clip((distance - 36) / 18, 0, 1) ** 1.3
    return height + mountains * (7.0 + 6.5 * ridge)


def on_ground(x, y, lift=0.0):
    """Return a point (3,) on the land, or ``lift`` above it."""
    return np.array([x, y, float(ground(np.array([x]), np.array([y]))[0]) + lift])


def land():
    """Create the land as one disc, finer towards the garden, with vertex colours."""
    rings = np.concatenate([[0.0], np.geomspace(0.4, 62, 250)])
    angle = np.linspace(0, 2 * math.pi, 640, endpoint=False)
    x = rings[:, None] * np.sin(angle)
    y = rings[:, None] * np.cos(angle)
    z = ground(x, y)
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    plan, height = points[:, :2], points[:, 2]
    distance = np.hypot(*plan.T)

    def tone(color):
        return np.array(linear(color)[:3])

    def blend(under, over, amount):
        return under + (over - under) * np.clip(amount, 0, 1)[:, None]

    paint = blend(tone("#7a9441"), tone("#a9ae55"), 0.5 + 0.6 * wobble(plan, 3, 0.35))
    paint = blend(paint, tone("#b8a24e"), (wobble(plan, 4, 0.16) - 0.15) * 5 * (distance > 9))  # ripe fields
    paint = blend(paint, tone("#7c8f3a"), (wobble(plan, 5, 0.2) - 0.2) * 5 * (distance > 9))
    forest = np.clip((distance - 30) / 4, 0, 1) * np.clip((44 - distance) / 6, 0, 1)
    paint = blend(paint, tone("#49683f"), forest * (0.8 + 0.3 * wobble(plan, 6, 0.5)))
    rock = (height - 4.2 - 1.5 * wobble(plan, 7, 0.3)) / 2.0
    paint = blend(paint, tone("#7d7488"), rock)
    paint = blend(paint, tone("#f3eef2"), (height - 8.6 - 1.6 * wobble(plan, 8, 0.45)) / 1.0)
    track = np.abs(plan[:, 0] - path_x(plan[:, 1])) - 0.55 - 0.12 * wobble(plan, 10, 2.5)
    yard = np.hypot(plan[:, 0], plan[:, 1] * 1.25) - 1.9 - 0.25 * wobble(plan, 11, 2.0)
    bare = np.where(plan[:, 1] > 0, np.minimum(track, yard), yard)
    paint = blend(paint, tone("#b59a72"), (0.10 - bare) / 0.15 * (distance < 26))
    paint = blend(paint, tone("#c3b6c8"), (distance - 14) / 75)  # atmospheric haze
    stuff = material(
        "land", ["#8a8a86", "#e9e6dc", "#ffffff"], scale=4.5, bump=0, attribute="paint", distortion=0.4
    )
    mesh("land", points, grid_faces(len(rings), len(angle), closed=True), stuff, colors=paint)


def sky():
    """Create a sky dome that is visible to cameras only. Light comes from world and sun."""
    painted = bpy.data.materials.new("sky")
    painted.use_nodes = True
    nodes, links = painted.node_tree.nodes, painted.node_tree.links
    nodes.clear()
    output, light = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeEmission")
    coordinates, split = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeSeparateXYZ")
    links.new(coordinates.outputs["Object"], split.inputs["Vector"])
    height = nodes.new("ShaderNodeMapRange")
    height.inputs["From Max"].default_value = 62.0
    links.new(split.outputs["Z"], height.inputs["Value"])
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = linear("#ffd9a8")
    ramp.color_ramp.elements[1].color = linear("#4f86c6")
    for position, color in ((0.16, "#fbd3b4"), (0.34, "#c9cfdf"), (0.6, "#86b1dd")):
        ramp.color_ramp.elements.new(position).color = linear(color)
    links.new(height.outputs["Result"], ramp.inputs["Fac"])
    mapping, noise = nodes.new("ShaderNodeMapping"), nodes.new("ShaderNodeTexNoise")
    mapping.inputs["Scale"].default_value = (0.028, 0.028, 0.1)
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = 1.5, 6.0
    noise.inputs["Distortion"].default_value = 0.3
    links.new(coordinates.outputs["Object"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], noise.inputs["Vector"])
    cover = nodes.new("ShaderNodeMapRange")
    cover.inputs["From Min"].default_value, cover.inputs["From Max"].default_value = 0.5, 0.68
    cover.inputs["To Max"].default_value = 0.85
    links.new(noise.outputs["Fac"], cover.inputs["Value"])
    mix = nodes.new("ShaderNodeMix")
    mix.data_type = "RGBA"
    mix.inputs["B"].default_value = linear("#fff0e2")
    links.new(cover.outputs["Result"], mix.inputs["Factor"])
    links.new(ramp.outputs["Color"], mix.inputs["A"])
    links.new(mix.outputs["Result"], light.inputs["Color"])
    links.new(light.outputs["Emission"], output.inputs["Surface"])
    bpy.ops.mesh.primitive_uv_sphere_add(segments=96, ring_count=48, radius=66)
    dome = bpy.context.object
    dome.name = "sky"
    dome.data.materials.append(painted)
    dome.data.shade_smooth()
    dome.visible_diffuse = dome.visible_glossy = dome.visible_shadow = dome.visible_transmission = False


def lights():
    """Add a low warm sun from behind left and a blue sky."""
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = linear("#b9cdf0")
    background.inputs["Strength"].default_value = 0.65
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle, sun.color = 4.2, math.radians(2.5), linear("#ffdcae")[:3]
    obj = bpy.data.objects.new("sun", sun)
    obj.rotation_euler = (math.radians(56), 0, math.radians(-48))
    bpy.context.scene.collection.objects.link(obj)


# ------------------------------------------------------------------------------------------- the table


def wood(name, tones=("#6b4526", "#94663a", "#b58350"), along=0, vary=0.18):
    """Create a wood material with its grain along an axis."""
    stretch = [7.0, 7.0, 7.0]
    stretch[along] = 0.6
    return material(
        name, list(tones), scale=2.2, stretch=tuple(stretch), distortion=1.6, bump=0.35, vary=vary
    )


def paper_lantern(at, color, radius=0.13, tall=1.15):
    """Add a round ribbed paper lantern that glows."""
    profile = [
        (radius * math.sin(t), -radius * tall * math.cos(t)) for t in np.linspace(0.28, math.pi - 0.28, 25)
    ]
    profile = [(r * (1 + 0.035 * (-1) ** i), z) for i, (r, z) in enumerate(profile)]
    glow = material(
        f"paper {color}",
        [color, "#fff1c9", color],
        pattern="bands",
        scale=0.62,
        stretch=(0, 0, 1 / radius / 4),
        bump=0,
        glow=0.35,
    )
    glow.node_tree.nodes["Wave Texture"].bands_direction = "Z"
    lathe("paper lantern", profile, glow, at=at, segments=36)
    cap = bpy.data.materials["dark wood"]
    for sign in (-1, 1):
        z = at[2] + sign * radius * tall * 0.97
        lathe("cap", [(0, -0.012), (0.045, -0.012), (0.045, 0.012), (0, 0.012)], cap, at=(at[0], at[1], z))
    lathe(
        "tassel",
        [(0.0, 0), (0.012, -0.01), (0.02, -0.09), (0, -0.09)],
        glow,
        at=(at[0], at[1], at[2] - radius * tall),
    )


def table():
    """Add the table and the objects on it."""
    plank, leg = wood("table", along=0), wood("legs", along=2)
    for i, y in enumerate(np.linspace(-0.36, 0.36, 5)):
        box("plank", (1.9 + 0.03 * (i % 2), 0.172, 0.045), plank, at=(0.01 * (i % 3), y, TABLE - 0.0225))
    for x in (-0.82, 0.82):
        for y in (-0.33, 0.33):
            box("leg", (0.085, 0.085, TABLE - 0.045), leg, at=(x, y, (TABLE - 0.045) / 2))
        box("rail", (0.05, 0.6, 0.09), leg, at=(x, 0, 0.22))
    box("rail", (1.64, 0.05, 0.1), plank, at=(0, -0.33, 0.66))

    # the runner: a woven cloth across the middle that hangs over the front
    u = np.linspace(-0.80, 0.62, 90)
    v = np.linspace(-0.27, 0.27, 34)
    s, w = np.meshgrid(u, v, indexing="ij")
    edge = 0.452
    over = np.clip(-edge - s, 0, None)
    y = np.where(s < -edge, -edge - 0.012 - 0.03 * np.sin(over * 6) * (1 + np.sin(w * 24)), s)
    over_back = np.clip(s - edge, 0, None)
    y = np.where(s > edge, edge + 0.012, y)
    z = TABLE + 0.006 - over - over_back + 0.002 * np.sin(s * 40 + w * 9)
    squares = np.floor(s / 0.06).astype(int) % 2 + np.floor((w + 0.27) / 0.06).astype(int) % 2
    cloth = np.array([linear(c)[:3] for c in ("#f4ead6", "#c9504a", "#9c2f33")])[squares]
    stuff = material("cloth", ["#cfcfcf", "#ffffff"], scale=60, bump=0.1, attribute="paint")
    runner = mesh(
        "runner",
        np.stack([w + 0.12, y, z], -1).reshape(-1, 3),
        grid_faces(90, 34),
        stuff,
        colors=cloth.reshape(-1, 3),
    )
    runner.modifiers.new("Solid", "SOLIDIFY").thickness = 0.006

    still_life()


def still_life():
    """Add fruit, jugs, books, bread and the lantern."""
    dark = material("dark wood", ["#3a2417", "#5a3a22"], scale=3, stretch=(8, 8, 1), bump=0.2)
    brass = material("brass", ["#8a6a2c", "#c79a48"], scale=20, bump=0.1)

    # the lantern: posts, a roof, lit paper panes
    x, y, z = rig.LANTERN
    paper = material("pane", ["#ffb347", "#ffe2a0"], pattern="noise", scale=7, bump=0, glow=0.9)
    box("lantern foot", (0.2, 0.2, 0.025), dark, at=(x, y, TABLE + 0.0125))
    box("pane", (0.145, 0.145, 0.36), paper, at=(x, y, TABLE + 0.205), bevel=0)
    for dx in (-0.078, 0.078):
        for dy in (-0.078, 0.078):
            box("post", (0.02, 0.02, 0.38), dark, at=(x + dx, y + dy, TABLE + 0.21), bevel=0.003)
    for h in (0.13, 0.25):
        for d in (-0.076, 0.076):
            box("bar", (0.15, 0.012, 0.012), dark, at=(x, y + d, TABLE + h), bevel=0.002)
            box("bar", (0.012, 0.15, 0.012), dark, at=(x + d, y, TABLE + h), bevel=0.002)
    roof = lathe(
        "lantern roof",
        [(0.16, 0), (0.165, 0.012), (0.05, 0.085), (0.03, 0.1), (0.0, 0.1)],
        dark,
        at=(x, y, TABLE + 0.395),
        segments=4,
        turn=math.pi / 4,
    )
    roof.data.shade_flat()
    lathe(
        "ring",
        smooth_profile([(0, 0.1), (0.018, 0.11), (0.022, 0.13), (0, 0.15)]),
        brass,
        at=(x, y, TABLE + 0.395),
    )

    # a basket of apples and oranges on the runner
    wicker = material(
        "wicker",
        ["#7a5226", "#c79a5b", "#e0bd80"],
        pattern="bands",
        scale=14,
        stretch=(1, 1, 3.2),
        distortion=3.0,
        bump=0.6,
    )
    basket = (0.13, 0.05, TABLE + 0.012)
    lathe(
        "basket",
        smooth_profile(
            [
                (0.0, 0.0),
                (0.13, 0.0),
                (0.17, 0.06),
                (0.195, 0.12),
                (0.2, 0.13),
                (0.185, 0.125),
                (0.15, 0.06),
                (0.0, 0.05),
            ],
            40,
        ),
        wicker,
        at=basket,
        segments=64,
        ribs=32,
        depth=0.03,
    )
    apple = material(
        "apple", ["#8f1d1f", "#c8322b", "#e3a63f"], scale=3.2, stretch=(1, 1, 0.4), bump=0, vary=0.12
    )
    orange = material("orange", ["#d9711c", "#f0932b"], scale=30, bump=0.35)
    green = material("green apple", ["#7d9b2c", "#b5c04a", "#d3c25c"], scale=4, bump=0.0)
    fruit = smooth_profile(
        [
            (0, -0.036),
            (0.02, -0.043),
            (0.045, -0.02),
            (0.05, 0.012),
            (0.03, 0.042),
            (0.008, 0.036),
            (0, 0.03),
        ],
        22,
    )
    kinds = [lathe("fruit", fruit, kind, at=(0, 0, -9), segments=28).data for kind in (apple, orange, green)]
    spots = [(0.09 * math.sin(a), 0.09 * math.cos(a), 0.115) for a in np.arange(6) * math.pi / 3]
    spots += [
        (0.0, 0.0, 0.13),
        (0.05, -0.04, 0.185),
        (-0.05, -0.02, 0.183),
        (0.0, 0.055, 0.185),
        (0, 0, 0.25),
    ]
    for i, spot in enumerate(spots):
        at = np.array(basket) + spot
        add_object(
            kinds[(i * 2 + i // 3) % 3], at, turn=i * 1.3, tilt=(0.4 * math.sin(i * 2), 0.4 * math.cos(i * 3))
        )
    for i, (fx, fy) in enumerate([(-0.12, -0.25), (-0.02, -0.31), (0.36, -0.27)]):
        add_object(kinds[(i + 1) % 3], (fx, fy, TABLE + 0.05), turn=i, tilt=(0.25, 0.1))

    # jug and bowl, matte and striped glaze
    stripes = material(
        "stripes",
        ["#e9e2d0", "#e9e2d0", "#3c5f8c", "#e9e2d0", "#e9e2d0"],
        pattern="bands",
        scale=5.5,
        stretch=(0, 0, 1),
        bump=0.0,
        distortion=0.6,
    )
    stripes.node_tree.nodes["Wave Texture"].bands_direction = "Z"
    jug = [
        (0, 0),
        (0.075, 0.0),
        (0.1, 0.06),
        (0.098, 0.12),
        (0.06, 0.19),
        (0.048, 0.23),
        (0.062, 0.27),
        (0.055, 0.268),
        (0.03, 0.2),
        (0, 0.18),
    ]
    lathe("jug", smooth_profile(jug, 44), stripes, at=(0.53, 0.2, TABLE), segments=48)
    bpy.ops.mesh.primitive_torus_add(
        major_radius=0.06,
        minor_radius=0.012,
        location=(0.625, 0.2, TABLE + 0.16),
        rotation=(math.pi / 2, 0, 0),
    )
    bpy.context.object.data.materials.append(stripes)
    stems = np.array([[0.53, 0.2, TABLE + 0.22]]) + rng.normal(size=(9, 3)) * [0.012, 0.012, 0.004]
    leaf = material("leaf", ["#d9d9d9", "#ffffff"], scale=8, bump=0.0, attribute="paint")
    scatter(
        "stems",
        stems,
        leaf,
        blades=3,
        height=0.22,
        width=0.012,
        colors=["#4d6b2a", "#6d8a39"],
        lean=0.5,
        seed=4,
    )
    blossoms(
        stems + np.array([0, 0, 0.19]) + rng.normal(size=(9, 3)) * [0.07, 0.07, 0.035],
        0.042,
        ["#f2e9dc", "#e9b13c", "#d9677d"],
    )

    # books, bread on a board, a candle, pumpkins
    pages = material("pages", ["#d9c9a0", "#f1e6c6"], pattern="bands", scale=30, stretch=(0, 0, 1), bump=0.1)
    pages.node_tree.nodes["Wave Texture"].bands_direction = "Z"
    z = TABLE
    for i, (color, turn) in enumerate([("#7a2e2a", 0.25), ("#2f4f63", -0.1), ("#5b6b35", 0.4)]):
        cover = material(f"cover {i}", [color, color, "#c9a45a"], pattern="noise", scale=14, bump=0.1)
        size = 0.25 - 0.025 * i
        center = (0.74, -0.17, z + 0.021)
        box("pages", (size - 0.012, 0.18, 0.03), pages, at=center, turn=turn, bevel=0.002)
        for side in (-0.018, 0.018):
            box(
                "cover",
                (size, 0.19, 0.005),
                cover,
                at=(0.74, -0.17, z + 0.021 + side),
                turn=turn,
                bevel=0.002,
            )
        z += 0.042
    wax = material("wax", ["#efe2c4", "#f7eed8"], scale=6, bump=0.05)
    lathe("candle", [(0, 0), (0.03, 0), (0.03, 0.11), (0.022, 0.118), (0, 0.112)], wax, at=(0.72, -0.17, z))
    flame = material("flame", ["#ffcf6b", "#fff0b8"], scale=4, bump=0, glow=1.0)
    lathe(
        "flame",
        smooth_profile([(0, 0), (0.011, 0.014), (0.006, 0.035), (0, 0.055)]),
        flame,
        at=(0.72, -0.17, z + 0.118),
        segments=16,
    )

    board = wood("board", ("#a37444", "#c79860", "#d8b07a"), along=0)
    box("board", (0.36, 0.2, 0.022), board, at=(-0.66, -0.2, TABLE + 0.011), turn=0.2, bevel=0.01)
    crust = material("crust", ["#7a4317", "#b06d2b", "#dca85e"], scale=9, bump=0.7)
    loaf = ball(
        "bread", 0.1, crust, at=(-0.69, -0.2, TABLE + 0.075), rough=0.04, frequency=4, seed=3, squash=0.58
    )
    loaf.scale, loaf.rotation_euler = (1.35, 0.8, 1), (0, 0, 0.25)
    cheese = material("cheese", ["#d9a52f", "#efc85a"], pattern="noise", scale=12, bump=0.15)
    lathe(
        "cheese",
        [(0, 0), (0.07, 0), (0.075, 0.02), (0.07, 0.045), (0, 0.045)],
        cheese,
        at=(-0.50, -0.25, TABLE + 0.022),
    )
    pumpkin((-0.2, 0.26, TABLE), 0.12, "#d9781f")
    pumpkin((-0.78, 0.2, TABLE), 0.09, "#d8c37a")
    pumpkin((0.82, 0.25, TABLE), 0.085, "#c4571c")


def pumpkin(at, radius, color):
    """Add a ribbed pumpkin with its stalk."""
    skin = material(f"pumpkin {color}", [color, "#efb04e"], scale=7, stretch=(1, 1, 0.3), bump=0.1)
    profile = smooth_profile(
        [(0, 0.06), (0.45, 0.0), (0.95, 0.35), (1.0, 0.7), (0.6, 1.15), (0.18, 1.12), (0, 1.02)], 30
    )
    body = [(r * radius, z * radius) for r, z in profile]
    lathe("pumpkin", body, skin, at=at, segments=96, ribs=11, depth=0.16)
    stalk = bpy.data.materials.get("stalk") or material("stalk", ["#5a5b2c", "#83803f"], scale=20, bump=0.4)
    top = at[2] + radius * 1.0
    lathe(
        "stalk",
        [(0.2 * radius, 0), (0.1 * radius, 0.15 * radius), (0.11 * radius, 0.4 * radius), (0, 0.42 * radius)],
        stalk,
        at=(at[0], at[1], top),
        segments=10,
    )


def blossoms(points, size, colors, seed=0):
    """Create flowers with six petals, facing up and outward, at points (N, 3)."""
    source = np.random.default_rng(seed + 100)
    count, petals = len(points), 6
    facing = source.normal(size=(count, 3)) * 0.45 + np.array([0, -0.25, 1.0])
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    first = np.cross(facing, [1.0, 0, 0])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(facing, first)
    angle = np.arange(2 * petals) * math.pi / petals
    reach = size * np.where(np.arange(2 * petals) % 2, 0.45, 1.0) * source.uniform(0.7, 1.2, (count, 1))
    rim = (
        first[:, None] * (reach * np.cos(angle))[..., None]
        + second[:, None] * (reach * np.sin(angle))[..., None]
    )
    rim += points[:, None] + facing[:, None] * size * 0.3
    vertices = np.concatenate([points[:, None], rim], axis=1)
    step = vertices.shape[1]
    corner = np.arange(2 * petals)
    triangle = np.stack([0 * corner, 1 + corner, 1 + (corner + 1) % (2 * petals)], axis=1)
    faces = (np.arange(count)[:, None, None] * step + triangle).reshape(-1, 3).tolist()
    palette = np.array([linear(color)[:3] for color in colors])
    chosen = palette[source.integers(len(palette), size=count)]
    paint = np.repeat(chosen[:, None], step, axis=1)
    paint[:, 0] = linear("#e0a020")[:3]
    stuff = bpy.data.materials.get("petal") or material(
        "petal", ["#e5e5e5", "#ffffff"], scale=9, bump=0, attribute="paint"
    )
    mesh("blossoms", vertices.reshape(-1, 3), faces, stuff, colors=paint.reshape(-1, 3), smooth=False)


# ------------------------------------------------------------------------------------------ the garden


def flower_pot(at, r, number):
    """Add a clay pot of radius r with flowers; ``number`` selects their colours."""
    x, y, z = at
    profile = [
        (0, 0),
        (0.68 * r, 0),
        (0.92 * r, 1.2 * r),
        (1.06 * r, 1.2 * r),
        (1.06 * r, 1.5 * r),
        (0.92 * r, 1.5 * r),
        (0.9 * r, 1.35 * r),
        (0, 1.35 * r),
    ]
    pot = lathe("pot", profile, bpy.data.materials["clay"], at=at, segments=48)
    pot.data.shade_flat()
    soil = bpy.data.materials["soil"]
    lathe("soil", [(0, 1.38 * r), (0.88 * r, 1.36 * r)], soil, at=at, segments=32)
    angle, reach = rng.uniform(0, 6.3, 26), r * 0.8 * np.sqrt(rng.uniform(0, 1, 26))
    roots = np.stack([x + reach * np.cos(angle), y + reach * np.sin(angle), np.full(26, z + 1.36 * r)], 1)
    scatter(
        "plant",
        roots,
        bpy.data.materials["leaf"],
        blades=5,
        height=r * 1.3,
        width=r * 0.11,
        lean=0.9,
        colors=["#4c7030", "#6b8f3a", "#88a552"],
        seed=20 + number,
    )
    tops = roots + rng.normal(size=(26, 3)) * [0.3 * r, 0.3 * r, 0.22 * r] + np.array([0, 0, r * 1.25])
    petals = [["#e0526b", "#f2a0ae"], ["#f3d04e", "#f2ead8"], ["#8d6cc4", "#c9b2e6"], ["#e8743b", "#f3c04e"]]
    blossoms(tops, r * 0.24, petals[number % 4], seed=number)


def garden():
    """Add the surroundings of the table: lantern posts, pots, crates, stones, grass and flowers."""
    post = wood("post", ("#4b3220", "#6c4a2c", "#8a6440"), along=2)
    ends = [(-1.55, 0.95), (1.55, 0.95)]
    for x, y in ends:
        box("post", (0.085, 0.085, 2.1), post, at=(x, y, 1.05))
        box("brace", (0.3, 0.05, 0.05), post, at=(x, y, 2.0))
    t = np.linspace(0, 1, 60)
    sag = 2.03 - 4 * 0.20 * t * (1 - t)
    line = np.stack([ends[0][0] + (ends[1][0] - ends[0][0]) * t, np.full_like(t, 0.95), sag], axis=1)
    rope = np.concatenate([np.add(line, offset) for offset in ((0, 0, 0), (0, 0, 0.012), (0, 0.012, 0.006))])
    faces = [
        (a * 60 + i, a * 60 + i + 1, b * 60 + i + 1, b * 60 + i)
        for a, b in ((0, 1), (1, 2), (2, 0))
        for i in range(59)
    ]
    mesh("rope", rope, faces, bpy.data.materials["dark wood"])
    for t, color in zip(
        (0.1, 0.26, 0.42, 0.58, 0.74, 0.9),
        ("#e8543f", "#f6b23c", "#5aa6a6", "#f08a6a", "#f3d36b", "#d4577c"),
        strict=True,
    ):
        height = 2.03 - 4 * 0.20 * t * (1 - t)
        paper_lantern((ends[0][0] + 3.1 * t, 0.95, height - 0.19 - 0.03 * math.sin(9 * t)), color)

    material("clay", ["#8f4a2b", "#b4643c", "#cf8558"], scale=9, bump=0.15, vary=0.15)
    material("soil", ["#2e2118", "#4a3626"], scale=30, bump=0.6)
    for i, (x, y, r) in enumerate(
        [
            (-1.25, -0.15, 0.19),
            (-1.05, 0.62, 0.16),
            (1.22, -0.1, 0.17),
            (1.15, 0.55, 0.21),
            (-0.55, -0.8, 0.13),
            (0.78, -0.85, 0.14),
        ]
    ):
        flower_pot((x, y, 0.0), r, i)

    crate = wood("crate", ("#8a6a44", "#b08c5e", "#c9a878"), along=0)
    for x, y, turn in ((-1.75, 0.35, 0.35), (1.85, 0.1, -0.3)):
        rotation = Matrix.Rotation(turn, 3, "Z")
        for side in (-0.2, 0.2):
            for level in range(3):
                at = rotation @ Matrix.Translation((0, side, 0.06 + 0.11 * level)).translation
                box("slat", (0.56, 0.02, 0.09), crate, at=(x + at.x, y + at.y, at.z), turn=turn, bevel=0.004)
                at = rotation @ Matrix.Translation((side * 1.35, 0, 0.06 + 0.11 * level)).translation
                box("slat", (0.02, 0.38, 0.09), crate, at=(x + at.x, y + at.y, at.z), turn=turn, bevel=0.004)
        apples = [data for data in bpy.data.meshes if data.name.startswith("fruit")]
        for _ in range(46):
            at = rotation @ Matrix.Translation((*rng.uniform(-1, 1, 2) * [0.22, 0.15], 0)).translation
            add_object(
                apples[int(rng.integers(3))],
                (x + at.x, y + at.y, 0.3 + rng.uniform(0, 0.06)),
                turn=rng.uniform(0, 6),
                tilt=rng.uniform(-0.6, 0.6, 2),
                scale=0.95,
            )
    pumpkin((-1.3, 0.2 - 0.75, 0.0), 0.17, "#d9781f")
    pumpkin((1.5, -0.45, 0.0), 0.22, "#cf6a1a")
    pumpkin((1.12, -0.62, 0.0), 0.12, "#d8c37a")

    # flat stones on the path and around the table
    stone = material("stone", ["#6d6a66", "#948f86", "#b5afa3"], scale=9, bump=0.5, vary=0.15)
    shapes = []
    for i in range(4):
        shapes.append(
            ball("stone", 1.0, stone, at=(0, 0, -9), rough=0.14, frequency=1.6, seed=40 + i, squash=0.22).data
        )
    steps = [
        (path_x(y) + rng.uniform(-0.25, 0.25), y, rng.uniform(0.16, 0.27)) for y in np.arange(1.2, 17, 0.48)
    ]
    steps += [
        (r * math.cos(a), 0.85 * r * math.sin(a) - 0.1, rng.uniform(0.13, 0.24))
        for r, n in ((1.05, 11), (1.6, 17))
        for a in np.arange(n) * 2 * math.pi / n + rng.uniform(-0.1, 0.1, n)
    ]
    for x, y, r in steps:
        add_object(shapes[int(rng.integers(4))], on_ground(x, y, -0.06 * r), turn=rng.uniform(0, 6), scale=r)

    # grass and flowers, sparser with distance, none on the path
    grass = material("grass", ["#e0e0e0", "#ffffff"], scale=1.5, bump=0, attribute="paint")

    def meadow(count, near, far):
        radius = near * (far / near) ** rng.uniform(0, 1, count)
        angle = rng.uniform(-2.3, 2.3, count)
        x, y = radius * np.sin(angle), radius * np.cos(angle)
        bare = np.where(y > 0, np.abs(x - path_x(y)) < 0.62, False) | (np.hypot(x, 1.25 * y) < 2.0)
        x, y = x[~bare], y[~bare]
        return np.stack([x, y, ground(x, y)], axis=1)

    greens = ["#6d8a38", "#839d43", "#97a74c", "#a8ad5a"]
    scatter(
        "grass",
        meadow(4200, 1.7, 10),
        grass,
        blades=7,
        height=0.11,
        width=0.016,
        colors=greens,
        lean=0.7,
        seed=1,
    )
    scatter(
        "far grass",
        meadow(2200, 8, 26),
        grass,
        blades=6,
        height=0.16,
        width=0.05,
        colors=greens,
        lean=0.7,
        seed=2,
    )
    for i, colors in enumerate((["#f4efe2"], ["#f2c84b"], ["#d8576a", "#e88f9c"], ["#8f7cc9"])):
        spots = meadow(2600, 1.8, 20)
        spots = spots[wobble(spots[:, :2], 60 + i, 0.8, 2) > 0.3]
        blossoms(spots + np.array([0, 0, 0.12]), 0.045, colors, seed=30 + i)


def path_side():
    """Add objects close to the path, for the set ``walk`` only: lanterns on poles, pots, pumpkins."""
    post, colors = bpy.data.materials["post"], ("#f6b23c", "#5aa6a6", "#e8543f", "#f3d36b", "#d4577c")
    for i, y in enumerate(np.arange(2.9, 9.2, 0.8)):
        side = -1 if i % 2 else 1
        x, _, z = on_ground(path_x(y) + 1.0 * side, y)
        box("pole", (0.06, 0.06, 2.15), post, at=(x, y, z + 1.0))
        box("arm", (0.36, 0.04, 0.04), post, at=(x - 0.14 * side, y, z + 2.0))
        paper_lantern((x - 0.25 * side, y, z + 1.65 + 0.06 * math.sin(5 * i)), colors[i % 5], radius=0.12)
        flower_pot((x + 0.02 * i, y - 0.22, z), 0.13 + 0.012 * (i % 4), i)
        if i % 3 == 1:
            pumpkin((x + 0.1 * side, y + 0.27, z), 0.15, "#d9781f")
    for i, (x, y) in enumerate([(-0.15, 2.25), (1.75, 2.6), (-0.55, 1.55)]):
        box("stool", (0.36, 0.36, 0.05), bpy.data.materials["crate"], at=(x, y, 0.62), turn=0.4 * i)
        for dx, dy in itertools.product((-0.12, 0.12), repeat=2):
            box("stool leg", (0.04, 0.04, 0.6), bpy.data.materials["crate"], at=(x + dx, y + dy, 0.3))
        flower_pot((x, y, 0.645), 0.15, i + 1)


# ----------------------------------------------------------------------------------------- background


def trees():
    """Add broad trees and pines, instanced over meadows and hills."""
    bark = material("bark", ["#3e2c20", "#5f4632", "#7a5d45"], scale=5, stretch=(6, 6, 1), bump=0.5)
    foliage = material("foliage", ["#bdbdbd", "#ffffff"], scale=2, bump=0, attribute="paint")
    crowns = []
    for i, tones in enumerate(
        (
            ["#4f7a34", "#6d9440", "#87a84e"],
            ["#b5602a", "#d68a35", "#e2ab4c"],
            ["#7d8f35", "#a8a640", "#c4b552"],
            ["#93412f", "#bd5a38", "#d17a45"],
        )
    ):
        source = np.random.default_rng(80 + i)
        lumps = source.normal(size=(9, 3)) * [0.62, 0.62, 0.42] + [0, 0, 2.35]
        direction = source.normal(size=(9, 420, 3))
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        leaves = (lumps[:, None] + direction * source.uniform(0.5, 0.75, (9, 420, 1))).reshape(-1, 3)
        # each leaf is a small diamond that faces roughly outward
        facing = direction.reshape(-1, 3) + source.normal(size=(len(leaves), 3)) * 0.5
        first = np.cross(facing, source.normal(size=(len(leaves), 3)))
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(facing, first)
        second /= np.linalg.norm(second, axis=1, keepdims=True)
        vertices = np.stack(
            [leaves - first * 0.12, leaves + second * 0.08, leaves + first * 0.12, leaves - second * 0.08], 1
        )
        palette = np.array([linear(tone)[:3] for tone in tones])
        paint = palette[source.integers(3, size=len(leaves))] * source.uniform(0.8, 1.2, (len(leaves), 1))
        faces = np.arange(4 * len(leaves)).reshape(-1, 4)
        crown = mesh(
            "crown", vertices.reshape(-1, 3), faces, foliage, at=(0, 0, -30), colors=np.repeat(paint, 4, 0)
        )
        crowns.append(crown.data)
    trunk = lathe(
        "trunk", [(0.2, -0.4), (0.14, 0.3), (0.11, 1.2), (0.05, 2.4)], bark, at=(0, 0, -30), segments=14
    ).data
    source = np.random.default_rng(90)
    tiers = []
    for tier in range(9):
        base, reach = 0.5 + 0.36 * tier, 0.95 * (1 - tier / 10)
        angle = np.arange(26) * 2 * math.pi / 26
        ragged = reach * np.where(np.arange(26) % 2, 1.0, 0.62) * source.uniform(0.85, 1.1, 26)
        rim = np.stack([ragged * np.cos(angle), ragged * np.sin(angle), base - 0.18 * ragged], 1)
        tiers.append(np.concatenate([rim, [[0, 0, base + 0.62]]]))
    vertices = np.concatenate(tiers)
    faces = [(27 * k + i, 27 * k + (i + 1) % 26, 27 * k + 26) for k in range(9) for i in range(26)]
    shade = np.where(np.arange(len(vertices)) % 27 == 26, 0.45, 1.0)[:, None]
    needles = np.array(linear("#3f6340")[:3]) * shade * source.uniform(0.75, 1.3, (len(vertices), 1))
    pine = mesh("pine", vertices, faces, foliage, at=(0, 0, -30), colors=needles, smooth=False).data

    def broad(x, y, size, kind):
        at, turn = on_ground(x, y), rng.uniform(0, 6)
        add_object(trunk, at, turn, scale=size)
        add_object(crowns[kind], at, turn, scale=size)

    for x, y, size, kind in (
        (-5.6, 8.2, 0.95, 1),
        (7.4, 9.4, 1.0, 0),
        (-10.5, 10.0, 1.2, 0),
        (10.2, 4.6, 1.1, 2),
        (-9.4, 3.2, 1.1, 3),
        (-2.6, 17.5, 0.9, 2),
        (11.5, 13.0, 1.2, 1),
    ):
        broad(x, y, size, kind)
    placed = 0
    while placed < 42:
        radius, angle = rng.uniform(15, 32), rng.uniform(-2.1, 2.1)
        x, y = radius * math.sin(angle), radius * math.cos(angle)
        before_hamlet = -0.66 < angle < -0.22 and radius < 26
        before_mill = 0.0 < angle < 0.4 and radius < 32
        if before_hamlet or before_mill or abs(x - path_x(y)) < 2:
            continue
        broad(x, y, rng.uniform(0.75, 1.25), int(rng.integers(4)))
        placed += 1
    radius, angle = rng.uniform(26, 44, 620), rng.uniform(-2.2, 2.2, 620)
    for x, y, size in zip(
        radius * np.sin(angle), radius * np.cos(angle), rng.uniform(0.5, 1.1, 620), strict=True
    ):
        spot = np.array([[x, y]])
        if wobble(spot, 50, 0.25, 2)[0] > -0.1 and math.hypot(x - MILL[0], y - MILL[1]) > 6:
            add_object(pine, on_ground(x, y), rng.uniform(0, 6), scale=size)


def buildings():
    """Add a hamlet to the left, a windmill on its hill, a fence along the path, and haystacks."""
    plaster = material("plaster", ["#d9c8a8", "#efe4cb", "#f6eedb"], scale=2.5, bump=0.15, vary=0.06)
    beam = material("beam", ["#4a3323", "#63462f"], scale=4, bump=0.2)
    tiles = material(
        "tiles",
        ["#7d3423", "#a94b30", "#c4673f"],
        pattern="bands",
        scale=3.2,
        stretch=(0.3, 0.3, 3),
        distortion=2.0,
        bump=0.6,
        vary=0.12,
    )
    lit = material("window", ["#ffc765", "#ffe0a0"], scale=2, bump=0, glow=0.8)

    def house(x, y, turn, wide, deep, tall):
        to_world = Matrix.Translation(on_ground(x, y).tolist()) @ Matrix.Rotation(turn, 4, "Z")

        def add_part(name, size, at, stuff, tilt=(0.0, 0.0)):
            position = to_world @ Matrix.Translation(at).to_translation()
            box(name, size, stuff, at=position, turn=turn, tilt=tilt, bevel=0.02)

        add_part("walls", (wide, deep, tall + 1.0), (0, 0, tall / 2 - 0.5), plaster)
        peak = 0.62 * deep
        gable = [
            (s * wide / 2, y, z)
            for s in (-1, 1)
            for y, z in ((-deep / 2, tall), (deep / 2, tall), (0, tall + peak))
        ]
        mesh(
            "gable",
            [to_world @ Matrix.Translation(v).to_translation() for v in gable],
            [(0, 1, 2), (3, 5, 4)],
            plaster,
            smooth=False,
        )
        slope = math.atan2(peak, deep / 2)
        length = math.hypot(peak, deep / 2) + 0.35
        for side in (-1, 1):
            center = (0, side * (deep / 4 + 0.08), tall + peak / 2 - 0.04)
            roof = box("roof", (wide + 0.5, length, 0.12), tiles, bevel=0.02)
            roof.matrix_basis = to_world @ Matrix.Translation(center) @ Matrix.Rotation(-side * slope, 4, "X")
        for sx in np.linspace(-0.5, 0.5, 4):
            add_part("beam", (0.12, 0.08, tall), (sx * (wide - 0.12), -deep / 2, tall / 2), beam)
        for z in (0.06, tall * 0.52, tall - 0.06):
            add_part("beam", (wide, 0.08, 0.12), (0, -deep / 2, z), beam)
        for sx in (-0.32, 0.34):
            for z in (0.3, 0.76):
                add_part("window", (0.42, 0.09, 0.42), (sx * wide, -deep / 2, tall * z), lit)
        add_part("door", (0.55, 0.1, 1.1), (0, -deep / 2, 0.55), beam)
        add_part("chimney", (0.35, 0.35, 1.0), (wide * 0.25, 0.2, tall + peak), plaster)

    house(-8.8, 18.5, 0.25, 3.6, 2.8, 2.4)
    house(-13.6, 20.5, 0.6, 3.2, 2.6, 2.2)
    house(-6.4, 23.0, 0.1, 3.0, 2.5, 2.6)
    house(12.0, 18.5, -0.5, 3.4, 2.7, 2.4)
    house(-15.5, 8.5, 1.0, 3.2, 2.6, 2.2)
    house(16.5, 8.5, -1.1, 3.2, 2.6, 2.2)

    # the windmill, built at the origin and moved to its hill
    mill = [
        lathe("mill", [(1.75, -0.8), (1.5, 1.2), (1.2, 3.2), (1.02, 4.4), (0, 4.4)], plaster, segments=12),
        lathe(
            "mill cap",
            smooth_profile([(1.3, 4.3), (1.15, 4.8), (0.6, 5.4), (0, 5.6)], 12),
            tiles,
            segments=24,
        ),
        box("mill door", (0.7, 0.12, 1.3), beam, at=(0, -1.52, 0.6)),
        box("mill window", (0.4, 0.2, 0.5), lit, at=(0, -1.28, 2.5)),
    ]
    mill[0].data.shade_flat()
    sail = material("sail", ["#e6dcc4", "#f7f1e0"], scale=3, bump=0.1)
    hub = Matrix.Translation((0, -1.4, 4.6))
    for turn in (28, 118, 208, 298):
        arm = hub @ Matrix.Rotation(math.radians(turn), 4, "Y")
        parts = [((0.12, 0.1, 3.3), (0, 0, 1.65), beam), ((0.72, 0.05, 2.5), (0.36, 0, 2.0), sail)]
        parts += [((0.8, 0.08, 0.05), (0.38, 0, rung), beam) for rung in np.linspace(0.8, 3.2, 7)]
        for size, at, stuff in parts:
            mill.append(box("sail", size, stuff, bevel=0))
            mill[-1].matrix_basis = arm @ Matrix.Translation(at)
    stand = (
        Matrix.Translation(on_ground(*MILL).tolist()) @ Matrix.Rotation(0.2, 4, "Z") @ Matrix.Scale(0.8, 4)
    )
    for part in mill:
        part.matrix_basis = stand @ part.matrix_basis

    rail = wood("fence", ("#7a6248", "#9c8262", "#b59c7a"), along=2)
    lying = wood("fence rail", ("#7a6248", "#9c8262", "#b59c7a"), along=0)
    for side in (-1.15, 1.15):
        y = np.arange(3.2, 14.5, 1.15)
        spots = [on_ground(path_x(value) + side, value) for value in y]
        for a, b in itertools.pairwise(spots):
            box(
                "fence post",
                (0.09, 0.09, 0.95),
                rail,
                at=np.add(a, (0, 0, 0.42)),
                turn=rng.uniform(-0.2, 0.2),
            )
            along = b - a
            for height in (0.4, 0.72):
                bar = box("fence rail", (float(np.linalg.norm(along)), 0.04, 0.08), lying)
                bar.location = (a + b) / 2 + [0, 0, height]
                bar.rotation_euler = (
                    0,
                    -math.atan2(along[2], math.hypot(*along[:2])),
                    math.atan2(along[1], along[0]),
                )
    straw = material("straw", ["#a8832f", "#d3b04e", "#ead083"], scale=6, stretch=(3, 3, 1), bump=0.8)
    for x, y, r in (
        (6.0, 9.5, 0.9),
        (7.6, 10.2, 0.8),
        (-5.6, 9.2, 0.85),
        (-11.5, 6.0, 0.9),
        (11.0, 7.2, 0.9),
    ):
        lathe(
            "haystack",
            smooth_profile(
                [(0.95 * r, -0.2), (r, 0.5 * r), (0.8 * r, 1.2 * r), (0.3 * r, 1.75 * r), (0, 1.85 * r)]
            ),
            straw,
            at=on_ground(x, y),
            segments=36,
            ribs=17,
            depth=0.06,
        )


# ------------------------------------------------------------------------------------------- rendering


def build():
    """Build the scene in an empty file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    land()
    sky()
    lights()
    table()
    garden()
    trees()
    buildings()


def set_up_rendering(samples: int, percentage: int):
    """Set up Cycles on the CPU with denoising, view transform Standard and no blur."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = True
    scene.cycles.adaptive_threshold = 0.03
    scene.cycles.use_denoising = True
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.cycles.max_bounces, scene.cycles.diffuse_bounces = 3, 2
    scene.cycles.use_light_tree = False
    scene.cycles.use_fast_gi, scene.cycles.ao_bounces_render = True, 1
    scene.world.light_settings.distance = 3.0
    scene.cycles.sample_clamp_indirect = 4.0
    scene.render.use_persistent_data = True
    scene.render.use_motion_blur = False
    scene.render.resolution_x, scene.render.resolution_y = rig.WIDTH, rig.HEIGHT
    scene.render.resolution_percentage = percentage
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    scene.view_layers[0].use_pass_position = True
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit, camera.sensor_width = "HORIZONTAL", 36.0
    camera.lens = 36.0 * rig.FOCAL / rig.WIDTH
    camera.clip_end = 500.0
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.collection.objects.link(scene.camera)


def render(out: Path, cameras: str, views: list[int] | None):
    """Render images and world positions of all or some views of a set."""
    scene = bpy.context.scene
    scene.use_nodes = True
    tree = scene.node_tree
    tree.nodes.clear()
    layers, store = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeOutputFile")
    composite = tree.nodes.new("CompositorNodeComposite")
    tree.links.new(layers.outputs["Image"], composite.inputs["Image"])
    store.base_path = str(out / "positions")
    store.format.file_format, store.format.color_depth, store.format.exr_codec = "OPEN_EXR", "32", "ZIP"
    store.file_slots[0].path = f"{cameras}_##"
    tree.links.new(layers.outputs["Position"], store.inputs[0])
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGB"
    poses = np.linalg.inv(rig.world_to_cameras(cameras)) @ np.diag([1.0, -1.0, -1.0, 1.0])
    for view in range(len(poses)) if views is None else views:
        scene.frame_set(view)
        scene.camera.matrix_world = Matrix(poses[view].tolist())
        scene.render.filepath = str(out / "images" / f"{rig.view_name(cameras, view)}.png")
        bpy.ops.render.render(write_still=True)


def animate(cameras: str):
    """Animate the scene's camera along a set, one frame per view."""
    scene = bpy.context.scene
    poses = np.linalg.inv(rig.world_to_cameras(cameras)) @ np.diag([1.0, -1.0, -1.0, 1.0])
    scene.camera.rotation_mode = "QUATERNION"
    for view, pose in enumerate(poses):
        scene.camera.matrix_world = Matrix(pose.tolist())
        for channel in ("location", "rotation_quaternion"):
            scene.camera.keyframe_insert(channel, frame=view)
    scene.frame_start, scene.frame_end = 0, len(poses) - 1


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--percentage", type=int, default=100, help="render size as a percentage of 480x320")
    sets = list(rig.SETS)
    parser.add_argument("--cameras", nargs="*", choices=sets, default=sets, help="sets of cameras to render")
    parser.add_argument("--views", type=int, nargs="*", help="numbers of the views to render; all by default")
    options = parser.parse_args()
    out = options.out.resolve()
    build()
    set_up_rendering(options.samples, options.percentage)
    for cameras in sorted(options.cameras, key=sets.index):  # walk last: it adds objects to the garden
        if cameras == "walk":
            path_side()
        render(out, cameras, options.views)
    animate("view")
    out.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "garden.blend"), compress=True)


if __name__ == "__main__":
    main()
