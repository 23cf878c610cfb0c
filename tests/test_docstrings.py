"""Docstrings of the public interface: numpydoc sections describe every parameter, the result, and the errors."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any, get_args

import pytest

import wrt
from tests.data import ROOT

MODULES = ("wrt.torch", "wrt.jax", "wrt.sensors", "wrt.testing", "wrt.compat.trimesh", "wrt.compat.open3d", "wrt.compat.pyvista",
           "wrt.compat.mujoco", "wrt.compat.newton", "wrt.picture.metrics")
CLASSES = ("wrt.accel.base:OneMesh", "wrt.accel.instances:Instances", "wrt.accel.queries.answers:Hits", "wrt.picture.film:Film",
           "wrt.compat.trimesh:RayMeshIntersector", "wrt.compat.open3d:RaycastingScene", "wrt.compat.pyvista:RayTracer",
           "wrt.compat.mujoco:ModelGeoms", "wrt.compat.newton:ModelScene")
WITHOUT_SECTIONS = ("wrt.kernels.structs",)  # modules whose docstrings have no sections yet
NOT_CALLED = ("pytest_addoption", "pytest_generate_tests", "located")  # functions that users do not call
# Types of results that need no section Returns.
PLAIN = re.compile(r"(float|int|str|bool|None|\w*(Mesh|Scene|Film|Hits|Refit)\w*|list\[str\]|[\s|])+")


def callables() -> Iterator[tuple[str, Callable[..., object], str]]:
    """Yield the name, the function, and the docstring of the class (else "") of all public functions and methods."""
    for home, names in [("wrt", wrt.__all__), *((each, None) for each in MODULES)]:
        module = importlib.import_module(home)
        for name in names or getattr(module, "__all__", vars(module)):
            thing = getattr(module, name)
            own = names or getattr(thing, "__module__", "").startswith("wrt.lab.hard_cases") or getattr(thing, "__module__", "") == home
            if inspect.isfunction(thing) and own and not name.startswith("_") and name not in NOT_CALLED:
                if thing.__module__ not in WITHOUT_SECTIONS:
                    yield f"{home}.{name}", thing, ""
    for place in CLASSES:
        home, name = place.split(":")
        for method, function in inspect.getmembers(getattr(importlib.import_module(home), name), inspect.isfunction):
            if not method.startswith("_") and function.__module__.startswith("wrt."):
                yield f"{name}.{method}", function, getattr(importlib.import_module(home), name).__doc__ or ""


def section(docstring: str, title: str) -> str:
    """Return the text of a numpydoc section, "" without one."""
    match = re.search(rf"^{title}\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", inspect.cleandoc(docstring), re.S | re.M)
    return match[1] if match else ""


def described(docstring: str) -> set[str]:
    """Return the names in the section Parameters, whose entries are `a, b : type` or `a, b`."""
    rows = re.findall(r"^(\S[^\n:]*?)(?: :[^\n]*)?$", section(docstring, "Parameters"), re.M)
    return {name.strip(" *") for row in rows for name in row.split(",")}


def parameters(function: Callable[..., object]) -> set[str]:
    """Return the names of the parameters. `**options: Unpack[Some]` stands for the fields of Some, unless `options` is described."""
    found = set()
    for name, each in inspect.signature(function).parameters.items():
        if each.kind is each.VAR_KEYWORD and name not in described(function.__doc__ or ""):
            kind = inspect.signature(function, eval_str=True).parameters[name].annotation
            found |= set(get_args(kind)[0].__annotations__) if get_args(kind) else {name}
        elif name not in ("self", "cls"):
            found.add(name)
    return found


@pytest.mark.parametrize("name, function, of_class", list(callables()), ids=[name for name, *_ in callables()])
def test_parameters_and_results_are_described(name: str, function: Callable[..., object], of_class: str) -> None:
    docstring = function.__doc__ or ""
    missing = parameters(function) - described(docstring) - described(of_class)
    # A method's first line may describe its only argument.
    first = docstring.split("\n")[0]
    assert docstring and (not missing or (of_class and len(missing) == 1 and (missing <= set(re.findall(r"\w+", first))))), missing
    result = re.sub(r"<class '|'>|[\w.]+\.", "", str(inspect.signature(function).return_annotation))  # without modules
    assert of_class or PLAIN.fullmatch(result) or section(docstring, "Returns") or section(docstring, "Yields"), result


def test_functions_that_check_arguments_say_what_they_raise() -> None:
    raising = [(name, function) for name, function, of_class in callables()
               if not of_class and re.search(r"raise InputError|\bas_(one|choice|integer)\(", inspect.getsource(function))]
    assert len(raising) > 5 and [name for name, function in raising if not section(function.__doc__ or "", "Raises")] == []


def test_the_site_shows_the_type_of_each_parameter() -> None:
    """Parameters that a docstring describes together without a type each get their own (docs/site/grouped_parameters.py)."""
    griffe = pytest.importorskip("griffe")
    extensions = griffe.load_extensions(ROOT / "docs" / "site" / "grouped_parameters.py")
    package = griffe.load("wrt", search_paths=[ROOT], extensions=extensions, docstring_parser="numpy",
                          docstring_options={"warn_unknown_params": False, "warn_missing_types": False})
    compared = 0
    for thing in public_objects(package):
        own = {each.name: each for each in thing.parameters}
        sections = thing.docstring.parsed if thing.docstring else []
        for shown in [each for section in sections if section.kind.value == "parameters" for each in section.value]:
            if shown.name in own and not re.search(rf"^(\S+, )*{re.escape(shown.name)}(, \S+)* : ", thing.docstring.value, re.M):
                assert str(shown.annotation) == str(own[shown.name].annotation), (thing.path, shown.name)
                compared += 1
    assert compared > 200


def public_objects(owner: Any) -> Iterator[Any]:
    """Yield the functions and classes that a griffe module or class defines, also in its modules and classes."""
    for member in owner.members.values():
        if not member.is_alias and (member.is_module or member.is_class or member.is_function):
            yield from [] if member.is_module else [member]
            yield from public_objects(member)
