"""How node groups are built: nodes from left to right, and formulas that read as formulas."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import bpy

VERSION, AS_MADE = "lodgs_version", "lodgs_as_made"
"""Custom properties of our groups: a group of another version, from an older file, is made anew; and what
:func:`_fingerprint` said of it when it was made."""

_SETTINGS = ("operation", "data_type", "domain", "transform_space", "input_type", "clamp", "mute")
"""What tells nodes of one type apart, where they have it."""


class Nodes:
    """Nodes of a tree, each to the right of all others.

    Attributes:
        tree: a group's or a material's.
    """

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def add(self, kind: str, **settings) -> bpy.types.Node:
        """A node to the right of all others."""
        node = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        node.location = (len(self.tree.nodes) * 180, 0)
        return node

    def link(self, source: bpy.types.NodeSocket, node: bpy.types.Node, name: str) -> None:
        """Links to the node's visible input of that name; several have the same in some node types."""
        self.tree.links.new(source, next(s for s in node.inputs if s.name == name and s.enabled))

    def math(self, operation: str, *values: bpy.types.NodeSocket | float) -> bpy.types.NodeSocket:
        """The result of a Math node on sockets and numbers."""
        node = self.add("ShaderNodeMath", operation=operation)
        for socket, value in zip(node.inputs, values, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = value
        return node.outputs["Value"]

    def vector(self, operation: str, *vectors: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """The result of a Vector Math node, a vector or a number."""
        node = self.add("ShaderNodeVectorMath", operation=operation)
        for socket, value in zip(node.inputs, vectors, strict=False):
            self.tree.links.new(value, socket)
        return next(socket for socket in node.outputs if socket.enabled)

    def named(self, name: str) -> bpy.types.NodeSocket:
        """An attribute of numbers; 0 where there is none of that name."""
        node = self.add("GeometryNodeInputNamedAttribute", data_type="FLOAT")
        node.inputs["Name"].default_value = name
        return next(s for s in node.outputs if s.name == "Attribute" and s.enabled)

    def sorted(self, points: bpy.types.NodeSocket, by: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """A geometry with its points in the order of a number, the smallest first."""
        node = self.add("GeometryNodeSortElements", domain="POINT")
        self.link(points, node, "Geometry")
        self.link(by, node, "Sort Weight")
        return node.outputs["Geometry"]

    def sampled(
        self,
        points: bpy.types.NodeSocket,
        values: bpy.types.NodeSocket,
        index: bpy.types.NodeSocket | int,
        *,
        kind: str = "FLOAT",
        clamp: bool = False,
    ) -> bpy.types.NodeSocket:
        """The value at one point of a geometry; 0, or with ``clamp`` the nearest, where there is none."""
        node = self.add("GeometryNodeSampleIndex", data_type=kind, domain="POINT", clamp=clamp)
        self.link(points, node, "Geometry")
        self.link(values, node, "Value")
        if isinstance(index, int):
            node.inputs["Index"].default_value = index
        else:
            self.link(index, node, "Index")
        return next(socket for socket in node.outputs if socket.enabled)

    def which(
        self, index: Field, *sources: bpy.types.NodeSocket, kind: str = "FLOAT"
    ) -> bpy.types.NodeSocket:
        """That one of several sources which a number names, counted from 0."""
        node = self.add("GeometryNodeIndexSwitch", data_type=kind)
        for _ in sources[2:]:
            node.index_switch_items.new()
        self.link(index.socket, node, "Index")
        for number, source in enumerate(sources):
            self.link(source, node, str(number))
        return node.outputs["Output"]

    def field(self, socket: bpy.types.NodeSocket) -> Field:
        """A socket to calculate with."""
        return Field(self, socket)


class Field:
    """A number, or one for each point, to calculate with: operators and methods add Math nodes.

    Comparisons give 1 where they hold, else 0.
    """

    def __init__(self, nodes: Nodes, socket: bpy.types.NodeSocket) -> None:
        self.nodes, self.socket = nodes, socket

    def _math(self, operation: str, *values: Field | float) -> Field:
        plain = (value.socket if isinstance(value, Field) else value for value in values)
        return Field(self.nodes, self.nodes.math(operation, *plain))

    def __add__(self, other: Field | float) -> Field:
        return self._math("ADD", self, other)

    def __sub__(self, other: Field | float) -> Field:
        return self._math("SUBTRACT", self, other)

    def __rsub__(self, other: float) -> Field:
        return self._math("SUBTRACT", other, self)

    def __mul__(self, other: Field | float) -> Field:
        return self._math("MULTIPLY", self, other)

    def __truediv__(self, other: Field | float) -> Field:
        return self._math("DIVIDE", self, other)

    def __rtruediv__(self, other: float) -> Field:
        return self._math("DIVIDE", other, self)

    def __gt__(self, other: Field | float) -> Field:
        return self._math("GREATER_THAN", self, other)

    def __lt__(self, other: Field | float) -> Field:
        return self._math("LESS_THAN", self, other)

    def __ge__(self, other: Field | float) -> Field:
        return 1.0 - (self < other)

    def __le__(self, other: Field | float) -> Field:
        return 1.0 - (self > other)

    def __and__(self, other: Field) -> Field:
        return self * other

    def maximum(self, other: Field | float) -> Field:
        return self._math("MAXIMUM", self, other)

    def minimum(self, other: Field | float) -> Field:
        return self._math("MINIMUM", self, other)

    def clip(self, low: Field | float, high: Field | float) -> Field:
        return self.maximum(low).minimum(high)

    def log2(self) -> Field:
        return self._math("LOGARITHM", self, 2.0)

    def log(self) -> Field:
        return self._math("LOGARITHM", self, 2.718281828459045)

    def exp(self) -> Field:
        return self._math("EXPONENT", self)

    def power(self, exponent: float) -> Field:
        return self._math("POWER", self, exponent)

    def sqrt(self) -> Field:
        return self._math("SQRT", self)

    def floor(self) -> Field:
        return self._math("FLOOR", self)

    def modulo(self, other: float) -> Field:
        return self._math("FLOORED_MODULO", self, other)

    def where(self, yes: Field | float, no: Field | float) -> Field:
        """``yes`` where this is 1, ``no`` where it is 0; the other side may be anything, infinite too."""
        node = self.nodes.add("GeometryNodeSwitch", input_type="FLOAT")
        self.nodes.link(self.socket, node, "Switch")
        for name, value in (("True", yes), ("False", no)):
            if isinstance(value, Field):
                self.nodes.link(value.socket, node, name)
            else:
                next(s for s in node.inputs if s.name == name and s.enabled).default_value = value
        return Field(self.nodes, next(s for s in node.outputs if s.enabled))


def group(name: str, version: int, build: Callable[[Nodes], None]) -> bpy.types.GeometryNodeTree:
    """The modifier group of that name, made where this file has none of this version.

    Args:
        build: adds the nodes to a group that has geometry in and out, and nothing else yet. An older group
            of that name is renamed: sockets of the new one may differ, so its users are to be given it anew.
            One of this version that somebody has changed (:func:`edited`) stays what it is.
    """
    there = bpy.data.node_groups.get((name, None))  # of this file, not of a library
    if isinstance(there, bpy.types.GeometryNodeTree) and there.get(VERSION) == version:
        return there
    if there is not None:
        there.name = f"{name} (older)"
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    assert isinstance(tree, bpy.types.GeometryNodeTree)
    tree.is_modifier = True
    tree[VERSION] = version
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    build(Nodes(tree))
    tree[AS_MADE] = _fingerprint(tree)
    return tree


_edited: dict[int, bool] = {}
"""What :func:`edited` has found, by ``session_uid``, until a group changes."""


def edited(tree: bpy.types.NodeTree) -> bool:
    """Whether somebody has changed one of our groups: it no longer does what the code says."""
    original = tree.original
    assert original is not None
    uid = original.session_uid
    if uid not in _edited:
        made = original.get(AS_MADE)  # older files do not say it
        _edited[uid] = made is not None and made != _fingerprint(original)
    return _edited[uid]


def _fingerprint(tree: bpy.types.NodeTree) -> str:
    """Of what a group does: its nodes, their settings and numbers, and links; not of how it is laid out."""
    said = []
    for node in tree.nodes:
        numbers = [
            (socket.identifier, _plain(socket.default_value))
            for socket in node.inputs
            if hasattr(socket, "default_value") and not socket.is_linked
        ]
        said.append((node.name, node.bl_idname, [getattr(node, name, "") for name in _SETTINGS], numbers))
    links = [
        (link.from_node.name, link.from_socket.identifier, link.to_node.name, link.to_socket.identifier)
        for link in tree.links
    ]
    sockets = [(item.name, item.item_type) for item in tree.interface.items_tree]
    return hashlib.sha256(repr((sorted(said), sorted(links), sockets)).encode()).hexdigest()[:16]


def _plain(value):
    """A socket's number, numbers or text as Python has them; the name of a datablock."""
    if isinstance(value, str | int | float | bool | None):
        return value
    return value.name if isinstance(value, bpy.types.ID) else tuple(value)


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if depsgraph.id_type_updated("NODETREE"):
        _edited.clear()


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    _edited.clear()


_ANEW = (bpy.app.handlers.load_post, bpy.app.handlers.undo_post, bpy.app.handlers.redo_post)


def register() -> None:
    bpy.app.handlers.depsgraph_update_post.append(_on_update)
    for handlers in _ANEW:
        handlers.append(_on_load)


def unregister() -> None:
    bpy.app.handlers.depsgraph_update_post.remove(_on_update)
    for handlers in _ANEW:
        handlers.remove(_on_load)


def fresh_driver(obj: bpy.types.Object, path: str, expression: str, index: int = -1) -> bpy.types.Driver:
    """A fresh driver of the property at ``path``, or of a vector's component, without variables."""
    obj.driver_remove(path, index)
    driver = obj.driver_add(path, index).driver
    assert driver is not None
    driver.type, driver.expression = "SCRIPTED", expression
    return driver


def take_away(obj: bpy.types.Object, modifier: bpy.types.NodesModifier) -> None:
    """Removes a modifier, its drivers, and its group if it was the last that has it.

    A group that somebody has changed is kept, for whoever wants it back.
    """
    for driver in list(obj.animation_data.drivers if obj.animation_data else ()):
        if driver.data_path.startswith(f'modifiers["{modifier.name}"]'):
            obj.animation_data.drivers.remove(driver)
    group = modifier.node_group
    obj.modifiers.remove(modifier)
    if group is not None and edited(group):
        group.use_fake_user = True
    elif group is not None and not group.users:
        bpy.data.node_groups.remove(group)


def modifier_with(obj: bpy.types.Object, key: str) -> bpy.types.NodesModifier | None:
    """The modifier whose group has a custom property, of any version."""
    for modifier in obj.modifiers:
        if (
            isinstance(modifier, bpy.types.NodesModifier)
            and modifier.node_group
            and key in modifier.node_group
        ):
            return modifier
    return None


def switched(obj: bpy.types.Object, group: bpy.types.GeometryNodeTree, **by: str) -> bpy.types.NodesModifier:
    """A new modifier with a group, which is on only where the active scene says so.

    Args:
        by: for "show_viewport", "show_render" or both the data path of a property of scenes. Without this
            extension it is off.
    """
    modifier = obj.modifiers.new(group.name, "NODES")
    assert isinstance(modifier, bpy.types.NodesModifier)
    modifier.node_group, modifier.show_expanded = group, False
    modifier.show_viewport = modifier.show_render = False
    for where, path in by.items():
        driver = fresh_driver(obj, f'modifiers["{modifier.name}"].{where}', "on")
        variable = driver.variables.new()
        variable.name, variable.type = "on", "CONTEXT_PROP"
        target = variable.targets[0]
        target.context_property, target.data_path = "ACTIVE_SCENE", path
        target.use_fallback_value, target.fallback_value = True, 0.0
    return modifier
