"""The small changes of a module, found in its syntax tree: one operator, comparison, constant, border or order each.

Nothing changes in annotations, decorators, docstrings, f-strings, `raise` statements, and what is said or logged.
"""

from __future__ import annotations

import ast
import copy
import random
from collections.abc import Iterator
from typing import NamedTuple

_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_OPPOSITES = {"min": "max", "any": "all", "minimum": "maximum", "argmin": "argmax", "floor": "ceil", "nanmin": "nanmax"}
_OPPOSITES |= {after: before for before, after in _OPPOSITES.items()}
_UNORDERED = {
    "min",
    "max",
    "minimum",
    "maximum",
    "hypot",
    "union1d",
    "intersect1d",
    "isclose",
    "allclose",
    "array_equal",
}
_SAYING = {"warn", "warning", "info", "debug", "note", "print", "echo", "cast", "TypeVar"}
_LONGEST = 110
"""Characters of a change's text: as much of the code around it as fits."""

Path = tuple[tuple[str, int | None], ...]
"""Fields, and places in lists, that lead from a module to a node."""


class Change(NamedTuple):
    """One small change of a module. number: its site's place in the module, and which of the site's changes it is.
    before, after: the code around it.  source: the whole changed module."""

    number: str
    line: int
    before: str
    after: str
    source: str


class Site(NamedTuple):
    """A node that may change. replacements: what may stand in its place."""

    path: Path
    line: int
    replacements: list[ast.AST]


def find_sites(tree: ast.Module) -> list[Site]:
    """Every node of a module that may change, in the order of the text."""
    return [
        Site(path, node.lineno, found)
        for path, node in _walk(tree, ())
        if (found := list(_replacements(node, _is_index(tree, path))))
    ]


def _is_index(tree: ast.Module, path: Path) -> bool:
    """Whether a constant counts from the end if it is negative, and so may mean the same."""
    parent = _follow(tree, path[:-1])
    return any(name == "slice" for name, _ in path[-3:]) or (isinstance(parent, ast.keyword) and parent.arg == "axis")


def sample_changes(source: str, seed: str, count: int) -> list[Change]:
    """So many changes of different sites, the first ones of a shuffled list: a larger count adds to a smaller one's."""
    rng = random.Random(seed)
    tree = ast.parse(source)
    order = list(enumerate(find_sites(tree)))
    rng.shuffle(order)
    return [_change(tree, site, number, rng.randrange(len(site.replacements))) for number, site in order[:count]]


def make_change(source: str, number: str) -> Change:
    """The change with this number. Raises ValueError or IndexError if the module has none."""
    tree = ast.parse(source)
    site, which = map(int, number.split("."))
    return _change(tree, find_sites(tree)[site], site, which)


def _change(tree: ast.Module, site: Site, number: int, which: int) -> Change:
    changed = copy.deepcopy(tree)
    parent: ast.AST = _follow(changed, site.path[:-1])
    name, place = site.path[-1]
    if place is None:
        setattr(parent, name, site.replacements[which])
    else:
        getattr(parent, name)[place] = site.replacements[which]
    ast.fix_missing_locations(changed)
    around = next(n for n in range(len(site.path) + 1) if _fits(_follow(tree, site.path[:n]), site.path[n:]))
    before, after = (_text(_follow(root, site.path[:around])) for root in (tree, changed))
    return Change(f"{number}.{which}", site.line, before, after, ast.unparse(changed) + "\n")


def _fits(node: ast.AST, rest: Path) -> bool:
    """Whether a node that holds a change is shown: a line or less."""
    is_line = isinstance(node, ast.expr) or (isinstance(node, ast.stmt) and not hasattr(node, "body"))
    return not rest or (is_line and len(_text(node)) <= _LONGEST)


def _text(node: ast.AST) -> str:
    text = ast.unparse(node)
    return " ".join(text.split()) if "\n" in text else text


def _follow(node: ast.AST, path: Path) -> ast.AST:
    for name, place in path:
        node = getattr(node, name) if place is None else getattr(node, name)[place]
    return node


def _walk(node: ast.AST, path: Path) -> Iterator[tuple[Path, ast.expr | ast.AugAssign]]:
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "ctx", "type_params", "bases"):
            continue
        children = enumerate(value) if isinstance(value, list) else [(None, value)]
        for place, child in children:
            if not isinstance(child, ast.AST) or _is_silent(child):
                continue
            here = (*path, (name, place))
            if isinstance(child, ast.expr | ast.AugAssign):
                yield here, child
            yield from _walk(child, here)


def _is_silent(node: ast.AST) -> bool:
    """Whether a change within a node says nothing about what a module does."""
    if isinstance(node, ast.Raise | ast.JoinedStr):
        return True
    if isinstance(node, ast.If):
        return ast.unparse(node.test).endswith("TYPE_CHECKING")
    if isinstance(node, ast.Assign) and isinstance(node.value, ast.BinOp):
        return isinstance(node.value.op, ast.BitOr) and ast.unparse(node.targets[0])[:1].isupper()  # a union of types
    if isinstance(node, ast.Subscript):
        return ast.unparse(node.value) in ("Literal", "Annotated")
    return isinstance(node, ast.Call) and _name(node.func) in _SAYING


def _name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def _replacements(node: ast.AST, is_index: bool) -> Iterator[ast.AST]:
    if isinstance(node, ast.BinOp | ast.AugAssign):
        left_of_format = isinstance(node, ast.BinOp) and isinstance(node.left, ast.Constant | ast.JoinedStr)
        if isinstance(node.op, ast.Mod) and left_of_format:
            return
        if type(node.op) in _OPERATORS:
            yield _with(node, op=_OPERATORS[type(node.op)]())
    elif isinstance(node, ast.Compare):
        for place, comparison in enumerate(node.ops):
            for other in _COMPARISONS[type(comparison)]:
                yield _with(node, ops=[*node.ops[:place], other(), *node.ops[place + 1 :]])
    elif isinstance(node, ast.BoolOp):
        yield _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.UnaryOp):
        if isinstance(node.op, ast.Not | ast.USub | ast.Invert):
            yield node.operand
    elif isinstance(node, ast.Constant):
        yield from _constants(node, is_index)
    elif isinstance(node, ast.Slice):
        yield from _borders(node)
    elif isinstance(node, ast.Call):
        yield from _calls(node)


def _constants(node: ast.Constant, is_index: bool) -> Iterator[ast.AST]:
    if isinstance(node.value, bool) or not isinstance(node.value, int | float):
        return
    yield ast.Constant(node.value + 1 if isinstance(node.value, int) or not node.value else 2 * node.value)
    if node.value and not is_index:
        yield ast.UnaryOp(ast.USub(), ast.Constant(node.value))


def _borders(node: ast.Slice) -> Iterator[ast.AST]:
    if node.step is not None or (node.lower is None and node.upper is None):
        return
    for side, other, step in (("lower", 1, ast.Add()), ("upper", -1, ast.Sub())):
        border = getattr(node, side)
        if border is None:
            yield _with(node, **{side: ast.Constant(other)})
        elif not isinstance(border, ast.Constant):
            yield _with(node, **{side: ast.BinOp(border, step, ast.Constant(1))})


def _calls(node: ast.Call) -> Iterator[ast.AST]:
    name = _name(node.func)
    if name in _OPPOSITES:
        function = copy.copy(node.func)
        setattr(function, "attr" if isinstance(function, ast.Attribute) else "id", _OPPOSITES[name])
        yield _with(node, func=function)
    if len(node.args) < 2 or name in _UNORDERED or any(isinstance(argument, ast.Starred) for argument in node.args):
        return
    for place in range(len(node.args) - 1):
        first, second = node.args[place : place + 2]
        if type(first) is type(second) and not _is_same(first, second):
            yield _with(node, args=[*node.args[:place], second, first, *node.args[place + 2 :]])


def _is_same(first: ast.expr, second: ast.expr) -> bool:
    """Whether two arguments are equal, or constants or types of NumPy: in each other's place, they fail at once."""
    texts = ast.unparse(first), ast.unparse(second)
    return texts[0] == texts[1] or any(text.startswith("np.") for text in texts)


def _with(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed
