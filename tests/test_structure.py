"""The shape of the program that no single module can hold."""

import ast
from pathlib import Path

import onedemo


def test_the_trainer_never_imports_the_app():
    files = sorted(Path(onedemo.__file__).parent.rglob("*.py"))
    assert len(files) > 20
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [name for name in names if name.split(".")[:2] == ["onedemo", "app"]], file
