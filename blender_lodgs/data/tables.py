"""Tables of a bundle in Blender: scene facts of rules, such as LODGE's chunks.

A table is a mesh with a vertex per row and an attribute per column (``attributes.COLUMN``), for node groups.
It is never drawn. Rows with a position and a radius get spheres that can be shown.
"""

from __future__ import annotations

import json

import bpy
import numpy as np

from ...training.lod.blocks import BLOCKS
from ...training.lod.rule import Tables, find_rule
from ...training.lod.rules.chunks import COLUMNS as SPHERE
from ...training.scenes.view_tables import VIEW_TABLES as VIEWS
from ..attributes import COLUMN
from .objects import read_column, write_column
from .placement import axes_of

_COLUMNS = "lodgs_columns"
"""Custom property of a table's mesh with its column names in order, as JSON."""


def set_tables(root: bpy.types.Object, tables: Tables) -> None:
    """Replace the tables of a splat scene. The scene's rule must be set before."""
    remove_tables(root)
    rule = find_rule(root.lodgs.rule)
    for name, columns in tables.items():
        if name in VIEWS:  # views are camera objects
            continue
        if name == BLOCKS:  # row ranges become invalid when splats are removed
            continue
        collection = bpy.data.collections.new(f"{root.name} {name}")
        collection.hide_viewport = collection.hide_render = True
        root.users_collection[0].children.link(collection)
        item = root.lodgs.tables.add()
        item.name, item.collection = name, collection
        item.object = _new_table(f"{root.name} {name}", columns)
        objects = [item.object]
        if rule is not None and name in rule.tables and all(column in columns for column in SPHERE):
            objects += _new_spheres(f"{root.name} {name.removesuffix('s')}", columns)
        for obj in objects:
            obj.parent = axes_of(root)
            collection.objects.link(obj)


def remove_tables(root: bpy.types.Object) -> None:
    """Remove all tables of a splat scene."""
    objects = parts(root)
    meshes = {obj.data for obj in objects} - {None}
    collections = {item.collection for item in root.lodgs.tables} - {None}
    bpy.data.batch_remove(objects)
    bpy.data.batch_remove([mesh for mesh in meshes if not mesh.users])
    root.lodgs.tables.clear()
    bpy.data.batch_remove([part for part in collections if not part.objects and not part.children])


def parts(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the objects of a splat scene's tables: meshes and spheres. A copy of a root has none."""
    collections = [item.collection for item in root.lodgs.tables if item.collection]
    objects = {item.object for item in root.lodgs.tables} | {
        obj for collection in collections for obj in collection.objects
    }
    return [obj for obj in objects if obj is not None and obj.parent == axes_of(root)]


def read_tables(root: bpy.types.Object) -> dict[str, dict[str, np.ndarray]]:
    """Return the tables of a splat scene: columns (rows,) by name."""
    return {item.name: read_table(item.object) for item in root.lodgs.tables if item.exists}


def read_table(obj: bpy.types.Object) -> dict[str, np.ndarray]:
    """Return the columns (rows,) of a table's object by name."""
    mesh = obj.data
    names = json.loads(mesh.get(_COLUMNS, "[]"))
    columns = {name: read_column(mesh, COLUMN.format(name), mesh) for name in names}
    return {name: values for name, values in columns.items() if values is not None}


def _new_table(name: str, columns: dict[str, np.ndarray]) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(name)
    mesh[_COLUMNS] = json.dumps(list(columns))
    mesh.vertices.add(len(next(iter(columns.values()), ())))
    for column, values in columns.items():
        write_column(mesh, COLUMN.format(column), values)
    obj = bpy.data.objects.new(name, mesh)
    obj.hide_viewport = obj.hide_render = obj.hide_select = True
    return obj


def _new_spheres(name: str, columns: dict[str, np.ndarray]) -> list[bpy.types.Object]:
    """Create a sphere empty with position and radius of each row, named by row number."""
    spheres = []
    for number, (*center, radius) in enumerate(zip(*(columns[column] for column in SPHERE), strict=True)):
        sphere = bpy.data.objects.new(f"{name} {number:02}", None)
        sphere.location, sphere.empty_display_size = center, radius
        sphere.empty_display_type, sphere.hide_select, sphere.show_name = "SPHERE", True, True
        spheres.append(sphere)
    return spheres
