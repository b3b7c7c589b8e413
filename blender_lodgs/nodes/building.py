"""Builders for node groups: nodes placed left to right, and fields with arithmetic operators."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import bpy

VERSION = "lodgs_version"
"""Custom property of LODGS groups: their version. A group of another version is replaced by a new one."""
FINGERPRINT = "lodgs_as_made"
"""Custom property of LODGS groups: :func:`_fingerprint` of the unedited group."""

_SETTINGS = ("operation", "data_type", "domain", "transform_space", "input_type", "clamp", "mute")
"""Node settings that enter the fingerprint; most node types have only some of them."""


class Nodes:
    """Builder that adds nodes to a tree from left to right.

    Attributes:
        tree: node tree of a group or a material.
    """

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def add(self, kind: str, **settings) -> bpy.types.Node:
        """Add a node to the right of the existing ones."""
        node = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        node.location = (len(self.tree.nodes) * 180, 0)
        return node

    def link(self, source: bpy.types.NodeSocket, node: bpy.types.Node, name: str) -> None:
        """Link a socket to the enabled input of that name. Some node types repeat input names."""
        self.tree.links.new(source, next(s for s in node.inputs if s.name == name and s.enabled))

    def math(self, operation: str, *values: bpy.types.NodeSocket | float) -> bpy.types.NodeSocket:
        """Add a Math node on sockets and numbers. Return its output."""
        node = self.add("ShaderNodeMath", operation=operation)
        for socket, value in zip(node.inputs, values, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = value
        return node.outputs["Value"]

    def vector(self, operation: str, *vectors: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Add a Vector Math node. Return its enabled output: a vector or a number."""
        node = self.add("ShaderNodeVectorMath", operation=operation)
        for socket, value in zip(node.inputs, vectors, strict=False):
            self.tree.links.new(value, socket)
        return next(socket for socket in node.outputs if socket.enabled)

    def attribute(self, name: str, kind: str = "FLOAT") -> bpy.types.NodeSocket:
        """Read a named attribute. Points without it read 0."""
        node = self.add("GeometryNodeInputNamedAttribute", data_type=kind)
        node.inputs["Name"].default_value = name
        return next(s for s in node.outputs if s.name == "Attribute" and s.enabled)

    def sort_points(self, points: bpy.types.NodeSocket, key: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Sort the points of a geometry by a key, smallest first."""
        node = self.add("GeometryNodeSortElements", domain="POINT")
        self.link(points, node, "Geometry")
        self.link(key, node, "Sort Weight")
        return node.outputs["Geometry"]

    def sample(
        self,
        points: bpy.types.NodeSocket,
        values: bpy.types.NodeSocket,
        index: bpy.types.NodeSocket | int,
        *,
        kind: str = "FLOAT",
        clamp: bool = False,
    ) -> bpy.types.NodeSocket:
        """Read the value at one point of a geometry.

        An index out of range reads 0, or with ``clamp`` the first or last point.
        """
        node = self.add("GeometryNodeSampleIndex", data_type=kind, domain="POINT", clamp=clamp)
        self.link(points, node, "Geometry")
        self.link(values, node, "Value")
        if isinstance(index, int):
            node.inputs["Index"].default_value = index
        else:
            self.link(index, node, "Index")
        return next(socket for socket in node.outputs if socket.enabled)

    def index_switch(
        self, index: Field, *sources: bpy.types.NodeSocket, kind: str = "FLOAT"
    ) -> bpy.types.NodeSocket:
        """Select one of several sources by an index that starts at 0."""
        node = self.add("GeometryNodeIndexSwitch", data_type=kind)
        for _ in sources[2:]:
            node.index_switch_items.new()
        self.link(index.socket, node, "Index")
        for number, source in enumerate(sources):
            self.link(source, node, str(number))
        return node.outputs["Output"]

    def field(self, socket: bpy.types.NodeSocket) -> Field:
        """Wrap a socket in a :class:`Field`."""
        return Field(self, socket)


class Field:
    """A number, or one number per point. Its operators and methods add Math nodes.

    Comparisons give 1 for true and 0 for false.
    """

    def __init__(self, nodes: Nodes, socket: bpy.types.NodeSocket) -> None:
        self.nodes, self.socket = nodes, socket

    def _math(self, operation: str, *values: Field | float) -> Field:
        operands = (value.socket if isinstance(value, Field) else value for value in values)
        return Field(self.nodes, self.nodes.math(operation, *operands))

    def __add__(self, value: Field | float) -> Field:
        return self._math("ADD", self, value)

    def __sub__(self, value: Field | float) -> Field:
        return self._math("SUBTRACT", self, value)

    def __rsub__(self, value: float) -> Field:
        return self._math("SUBTRACT", value, self)

    def __mul__(self, value: Field | float) -> Field:
        return self._math("MULTIPLY", self, value)

    def __truediv__(self, value: Field | float) -> Field:
        return self._math("DIVIDE", self, value)

    def __rtruediv__(self, value: float) -> Field:
        return self._math("DIVIDE", value, self)

    def __gt__(self, value: Field | float) -> Field:
        return self._math("GREATER_THAN", self, value)

    def __lt__(self, value: Field | float) -> Field:
        return self._math("LESS_THAN", self, value)

    def __ge__(self, value: Field | float) -> Field:
        return 1.0 - (self < value)

    def __le__(self, value: Field | float) -> Field:
        return 1.0 - (self > value)

    def __and__(self, value: Field) -> Field:
        return self * value

    def maximum(self, value: Field | float) -> Field:
        return self._math("MAXIMUM", self, value)

    def minimum(self, value: Field | float) -> Field:
        return self._math("MINIMUM", self, value)

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

    def modulo(self, value: float) -> Field:
        return self._math("FLOORED_MODULO", self, value)

    def where(self, true: Field | float, false: Field | float) -> Field:
        """Select ``true`` where this field is 1 and ``false`` where it is 0.

        The value that is not selected may be infinite or NaN.
        """
        node = self.nodes.add("GeometryNodeSwitch", input_type="FLOAT")
        self.nodes.link(self.socket, node, "Switch")
        for name, value in (("True", true), ("False", false)):
            if isinstance(value, Field):
                self.nodes.link(value.socket, node, name)
            else:
                next(s for s in node.inputs if s.name == name and s.enabled).default_value = value
        return Field(self.nodes, next(s for s in node.outputs if s.enabled))


def ensure_group(name: str, version: int, build: Callable[[Nodes], None]) -> bpy.types.GeometryNodeTree:
    """Return the modifier group of a name and version. Build it if this file has none.

    A group of another version is renamed, because its sockets may differ. Its users keep it until they are
    given the new group. An edited group of this version (:func:`is_edited`) is returned unchanged.

    Args:
        name: name of the group.
        version: number that must be raised whenever ``build`` changes.
        build: function that adds nodes to a group that has only its Geometry input and output.
    """
    existing = bpy.data.node_groups.get((name, None))  # in this file, not in a library
    if isinstance(existing, bpy.types.GeometryNodeTree) and existing.get(VERSION) == version:
        return existing
    if existing is not None:
        existing.name = f"{name} (older)"
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    assert isinstance(tree, bpy.types.GeometryNodeTree)
    tree.is_modifier = True
    tree[VERSION] = version
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    build(Nodes(tree))
    tree[FINGERPRINT] = _fingerprint(tree)
    return tree


_edited: dict[int, bool] = {}
"""Results of :func:`is_edited` by ``session_uid``, valid until a group changes."""


def is_edited(tree: bpy.types.NodeTree) -> bool:
    """Return whether a user has changed the nodes of a LODGS group."""
    original = tree.original
    assert original is not None
    uid = original.session_uid
    if uid not in _edited:
        fingerprint = original.get(FINGERPRINT)  # missing in files of older versions
        _edited[uid] = fingerprint is not None and fingerprint != _fingerprint(original)
    return _edited[uid]


def _fingerprint(tree: bpy.types.NodeTree) -> str:
    """Hash the nodes of a group with their settings, input values and links. Ignore their layout."""
    nodes = []
    for node in tree.nodes:
        values = [
            (socket.identifier, _as_python(socket.default_value))
            for socket in node.inputs
            if hasattr(socket, "default_value") and not socket.is_linked
        ]
        nodes.append((node.name, node.bl_idname, [getattr(node, name, "") for name in _SETTINGS], values))
    links = [
        (link.from_node.name, link.from_socket.identifier, link.to_node.name, link.to_socket.identifier)
        for link in tree.links
    ]
    sockets = [(item.name, item.item_type) for item in tree.interface.items_tree]
    return hashlib.sha256(repr((sorted(nodes), sorted(links), sockets)).encode()).hexdigest()[:16]


def _as_python(value):
    """Convert a socket value to a plain Python value. A datablock becomes its name."""
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


_RELOAD_HANDLERS = (bpy.app.handlers.load_post, bpy.app.handlers.undo_post, bpy.app.handlers.redo_post)


def register() -> None:
    bpy.app.handlers.depsgraph_update_post.append(_on_update)
    for handlers in _RELOAD_HANDLERS:
        handlers.append(_on_load)


def unregister() -> None:
    bpy.app.handlers.depsgraph_update_post.remove(_on_update)
    for handlers in _RELOAD_HANDLERS:
        handlers.remove(_on_load)


def replace_driver(obj: bpy.types.Object, path: str, expression: str, index: int = -1) -> bpy.types.Driver:
    """Replace the driver of a property by a new one without variables.

    Args:
        obj: owner of the property.
        path: data path of the property.
        expression: expression of the new driver.
        index: component of a vector property, or -1.
    """
    obj.driver_remove(path, index)
    driver = obj.driver_add(path, index).driver
    assert driver is not None
    driver.type = "SCRIPTED"
    driver.expression = expression
    return driver


def remove_modifier(obj: bpy.types.Object, modifier: bpy.types.NodesModifier | None) -> None:
    """Remove a modifier and its drivers; an edited node group is kept with a fake user.

    Other groups without users are not saved. Removing them here, in a handler of updates, crashes Blender 5.2
    and newer if another scene has been evaluated.

    Args:
        modifier: modifier to remove; None does nothing.
    """
    if modifier is None:
        return
    for driver in list(obj.animation_data.drivers if obj.animation_data else ()):
        if driver.data_path.startswith(f'modifiers["{modifier.name}"]'):
            obj.animation_data.drivers.remove(driver)
    group = modifier.node_group
    obj.modifiers.remove(modifier)
    if group is not None and is_edited(group):
        group.use_fake_user = True


def find_modifier(obj: bpy.types.Object, key: str) -> bpy.types.NodesModifier | None:
    """Return the modifier whose node group has the custom property ``key``, in any version."""
    for modifier in obj.modifiers:
        if (
            isinstance(modifier, bpy.types.NodesModifier)
            and modifier.node_group
            and key in modifier.node_group
        ):
            return modifier
    return None


def add_modifier(
    obj: bpy.types.Object, group: bpy.types.GeometryNodeTree, name: str = ""
) -> bpy.types.NodesModifier:
    """Add a modifier with a node group to an object, with a closed panel and by default the group's name."""
    modifier = obj.modifiers.new(name or group.name, "NODES")
    assert isinstance(modifier, bpy.types.NodesModifier)
    modifier.node_group, modifier.show_expanded = group, False
    return modifier


def add_switched_modifier(
    obj: bpy.types.Object, group: bpy.types.GeometryNodeTree, **switches: str
) -> bpy.types.NodesModifier:
    """Add a modifier that a property of the active scene switches on and off.

    Args:
        obj: object that receives the modifier.
        group: node group of the modifier.
        **switches: data path of a scene property for "show_viewport", "show_render" or both. The modifier is
            off if this extension is missing.
    """
    modifier = add_modifier(obj, group)
    modifier.show_viewport = modifier.show_render = False
    for switch, path in switches.items():
        read_scene(replace_driver(obj, f'modifiers["{modifier.name}"].{switch}', "on"), "on", path)
    return modifier


def read_scene(driver: bpy.types.Driver, name: str, path: str, fallback: float | None = 0.0) -> None:
    """Give a driver a variable with a property of the active scene.

    Args:
        driver: driver that receives the variable.
        name: name of the variable.
        path: data path of the property.
        fallback: value without the property, such as one of this extension if it is missing; None: an error.
    """
    variable = driver.variables.new()
    variable.name, variable.type = name, "CONTEXT_PROP"
    target = variable.targets[0]
    target.context_property, target.data_path = "ACTIVE_SCENE", path
    if fallback is not None:
        target.use_fallback_value, target.fallback_value = True, fallback
