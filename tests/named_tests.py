"""Tests that are referred to by name, ``tests/test_x.py::test_y``: a reference to one that is gone must not survive it."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]


def is_test(reference: str) -> bool:
    """
    :param reference: file, from the project's root, and function
    :return: whether pytest collects it
    """
    file, _, name = reference.partition("::")
    path = ROOT / file
    if not (path.is_file() and path.name.startswith("test_") and name.startswith("test_")):
        return False
    return any(isinstance(node, ast.FunctionDef) and node.name == name for node in ast.parse(path.read_text()).body)
