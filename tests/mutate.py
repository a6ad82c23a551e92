"""Mutants of one module: it is changed in one place at a time, and its tests should notice. What they do not notice is
in mutants.md beside this file, with the reason.

    python tests/mutate.py nmfd.model.dynamics tests/test_dynamics.py tests/test_ledger.py --log dynamics.log

Every mutant runs in a forked process, in which pytest stops at the first failure. The same command goes on where it was
interrupted: what is in the log is not run again.
"""

import argparse
import ast
import copy
import importlib
import importlib.util
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import casadi  # noqa: F401  so that no child has to import what takes long
import pytest
import torch

HERE = Path(__file__).parent
OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE,
    ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot,
    ast.IsNot: ast.Is, ast.And: ast.Or, ast.Or: ast.And, ast.USub: ast.UAdd}
NAMES = {"min": "max", "minimum": "maximum", "all": "any", "floor": "ceil"}
NAMES |= {other: name for name, other in NAMES.items()}
OPTIONS = ("-x", "-q", "-p", "no:cacheprovider", "-o", "addopts=", "-m", "not slow")
SECONDS = 20  # of CPU, after which a mutant counts as noticed: it does not end


def changed(node: ast.AST) -> bool:
    """Change `node` in place; False if there is nothing to change."""
    match node:
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op) | ast.UnaryOp(op=op) if type(op) in OPERATORS:
            node.op = OPERATORS[type(op)]()
        case ast.UnaryOp(op=ast.Not()):
            node.operand = ast.UnaryOp(ast.Not(), node.operand)
        case ast.Compare(ops=[op, *_]) if type(op) in OPERATORS:
            node.ops[0] = OPERATORS[type(op)]()
        case ast.Constant(value=bool() | int() | float() as value):
            node.value = not value if isinstance(value, bool) else value + 1
        case ast.Attribute(attr=name) if name in NAMES:
            node.attr = NAMES[name]
        case ast.Name(id=name) if name in NAMES:
            node.id = NAMES[name]
        case ast.IfExp():
            node.body, node.orelse = node.orelse, node.body
        case ast.Break() | ast.Continue():
            node.__class__ = ast.Pass
        case ast.Expr(value=ast.Call()):
            node.value = ast.Constant(None)
        case _:
            return False
    return True


def mutants(source: str) -> Iterator[tuple[str, ast.Module]]:
    """Place and kind of the change, and the changed module. Annotations and error messages are left alone."""
    tree = ast.parse(source)
    tops = [node for node in ast.walk(tree) if isinstance(node, ast.Raise)] + [
        top for node in ast.walk(tree) for key in ("annotation", "returns") if (top := getattr(node, key, None))]
    left = {id(part) for top in tops for part in ast.walk(top)}
    for number, original in enumerate(ast.walk(tree)):
        if id(original) not in left and changed(copy.deepcopy(original)):
            mutant = copy.deepcopy(tree)
            node = list(ast.walk(mutant))[number]
            changed(node)
            yield (f"line {original.lineno}:{original.col_offset}: {ast.unparse(original)}  ->  {ast.unparse(node)}",
                   ast.fix_missing_locations(mutant))


def noticed(name: str, tree: ast.Module, tests: list[str]) -> bool:
    """Whether the tests fail with `tree` as the module `name`."""
    child = os.fork()
    if child == 0:
        silent, code = os.open(os.devnull, os.O_WRONLY), 1
        os.dup2(silent, 1), os.dup2(silent, 2)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        with suppress(BaseException):
            spec = importlib.util.find_spec(name)
            module = sys.modules[name] = importlib.util.module_from_spec(spec)
            exec(compile(tree, spec.origin, "exec"), module.__dict__)
            setattr(sys.modules[name.rpartition(".")[0]], name.rpartition(".")[2], module)
            code = int(pytest.main([*OPTIONS, *tests]))
        os._exit(code)
    return os.waitpid(child, 0)[1] != 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("module", help="such as nmfd.model.dynamics")
    parser.add_argument("tests", nargs="+", help="what pytest is to run, the quickest first")
    parser.add_argument("--log", type=Path, required=True, help="a line per mutant; what is in it is not run again")
    order = parser.parse_args()
    sys.path[:0] = [str(HERE), str(HERE.parent)]
    torch.set_num_threads(1)
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    importlib.import_module(order.module)  # with all that it needs; who needs it is imported in every child
    source = (HERE.parent / order.module.replace(".", "/")).with_suffix(".py").read_text()
    if noticed(order.module, ast.parse(source), order.tests):
        sys.exit("the tests fail without a mutant")
    done = order.log.read_text().splitlines() if order.log.exists() else []
    for what, tree in mutants(source):
        if not any(line.endswith(what) for line in done):
            with order.log.open("a") as log:
                print("noticed" if noticed(order.module, tree, order.tests) else "SURVIVED", what, file=log)
    done = order.log.read_text().splitlines()
    print(*(line for line in done if line.startswith("SURVIVED")), sep="\n")
    print(f"{sum(line.startswith('noticed') for line in done)} of {len(done)} noticed")


if __name__ == "__main__":
    main()
