"""The public interface: what is exported is named once, documented, tested and safe to call."""

import ast
import inspect
import os
import pathlib
import subprocess
import sys
import types

import pytest

import shadows
import tangentspace
import tangentspace.shapes

PACKAGES = [tangentspace, shadows]
ROOT = pathlib.Path(__file__).parent.parent


def public(module):
    """Public names of a package, and what they stand for."""
    names = {name: getattr(module, name) for name in dir(module) if not name.startswith("_")}
    return {name: x for name, x in names.items() if not inspect.ismodule(x)}


def own(module):
    """Public functions that a module defines itself."""
    return {
        name: x
        for name, x in public(module).items()
        if inspect.isfunction(x) and x.__module__ == module.__name__
    }


EVERY = [(name, x) for module in PACKAGES for name, x in public(module).items()]
FUNCTIONS = [(name, x) for name, x in EVERY if inspect.isfunction(x)]
FUNCTIONS += list(own(tangentspace.shapes).items())
CLASSES = [(name, x) for name, x in EVERY if inspect.isclass(x)]
METHODS = [
    (f"{name}.{key}", method)
    for name, cls in CLASSES
    for key, method in vars(cls).items()
    if not key.startswith("_") and (inspect.isfunction(method) or isinstance(method, property))
]


def ids(pairs):
    return {"argvalues": [x for _, x in pairs], "ids": [name for name, _ in pairs]}


def test_there_is_something_to_check():
    assert len(FUNCTIONS) > 15
    assert len(CLASSES) > 15
    assert len(METHODS) > 15


# Every name is documented: an alias of types cannot hold a docstring of its own.
DOCUMENTED = [(n, x) for n, x in EVERY if not isinstance(x, types.UnionType)]


@pytest.mark.parametrize("thing", **ids(DOCUMENTED + list(own(tangentspace.shapes).items())))
def test_public_name_has_a_docstring(thing):
    doc = thing.__doc__
    assert doc
    assert not doc.startswith(f"{thing.__name__}("), "made by the machine, from the fields"
    summary = doc.strip().splitlines()[0]
    assert summary.endswith("."), "a summary is one sentence on one line"


@pytest.mark.parametrize("method", **ids(METHODS))
def test_public_method_has_a_docstring(method):
    assert method.__doc__


@pytest.mark.parametrize("function", **ids(FUNCTIONS))
def test_arguments_are_described(function):
    """The docstring tells of each, where there is more than can be said in its summary."""
    doc = function.__doc__
    if "Args:" in doc:
        names = [name.lstrip("*") for name in inspect.signature(function).parameters]
        missing = [name for name in names if f"{name}: " not in doc.split("Args:")[1]]
        assert not missing


@pytest.mark.parametrize("function", **ids(FUNCTIONS))
def test_options_are_keyword_only(function):
    """By position only data is passed: what has a default is an option, and so is a switch."""
    data = ("half_width", "half_extents", "radius", "major_radius", "minor_radius", "to_camera")
    for name, parameter in inspect.signature(function).parameters.items():
        option = parameter.default is not parameter.empty and name not in data
        if option or parameter.annotation in (bool, str):
            assert parameter.kind is parameter.KEYWORD_ONLY, f"`{name}` can be passed by position"


@pytest.mark.parametrize("function", **ids(FUNCTIONS))
def test_every_argument_has_a_type(function):
    signature = inspect.signature(function)
    untyped = [n for n, p in signature.parameters.items() if p.annotation is p.empty]
    assert not untyped
    assert signature.return_annotation is not signature.empty


@pytest.mark.parametrize("module", PACKAGES, ids=lambda module: module.__name__)
def test_init_is_one_explicit_list(module):
    """``from .a import b as b``, nothing else, no star, each name once and in order."""
    tree = ast.parse(pathlib.Path(module.__file__).read_text())
    docstring, *imports = tree.body
    assert isinstance(docstring, ast.Expr)
    names = []
    for node in imports:
        assert isinstance(node, ast.ImportFrom), ast.unparse(node)
        assert node.level == 1, ast.unparse(node)
        for alias in node.names:
            assert alias.asname == alias.name, ast.unparse(node)
            names.append(alias.name)
    assert len(names) == len(set(names))
    assert set(public(module)) <= set(names)


def test_every_public_function_and_class_is_tested():
    """Not what is only ever met as a result or as a base: the classes that a user makes."""
    here = pathlib.Path(__file__)
    trees = [ast.parse(path.read_text()) for path in here.parent.glob("test_*.py") if path != here]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    used = {node.id for node in nodes if isinstance(node, ast.Name)}
    used |= {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    made = [n for n, x in CLASSES if not inspect.isabstract(x) and not issubclass(x, tuple)]
    untested = ({name for name, _ in FUNCTIONS} | set(made)) - used
    assert not untested, sorted(untested)


IMPORT = """
import sys
import jax
before = dict(jax.config.values)
import tangentspace, shadows
assert jax.config.values == before, "importing changed a setting of jax"
for name in ("matplotlib", "experiments", "trimesh", "OpenEXR", "embreex", "optimistix"):
    assert name not in sys.modules, f"importing loaded {name}"
"""


def test_importing_has_no_effect():
    """No setting changed, nothing plotted, no array built: there is no device to build it on."""
    environment = os.environ | {"JAX_PLATFORMS": "no_such_device", "JAX_ENABLE_X64": "0"}
    subprocess.run(
        [sys.executable, "-c", IMPORT], env=environment, cwd=ROOT, check=True, timeout=60
    )


def test_local_shading_does_not_know_of_shadows():
    """Imports point one way: shadows use tangentspace, never the other way round."""
    code = "import sys, tangentspace; assert 'shadows' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=60)
