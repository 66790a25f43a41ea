"""The reference, read from the package: a page for each module, and one for each package that lists its modules."""

import ast
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

PACKAGE = Path(__file__).parents[2] / "phd_exp"
PRIVATE = {"cli"}  # packages that only this programme imports
GLOSSARY = "This package also holds the [glossary](../../glossary.md) of symbols.\n"
OWN_TEXT = "::: phd_exp.{}\n    options: {{members: false, show_root_heading: false}}\n"


def pages() -> dict[str, str]:
    """Address -> Markdown of every page, in the order of the contents."""
    found = {"api/index.md": "# phd_exp\n\n::: phd_exp\n    options: {show_root_heading: false}\n"}
    for folder in sorted(file.parent for file in PACKAGE.glob("*/__init__.py")):
        if folder.name not in PRIVATE:
            found |= _package(folder)
    return found


def _package(folder: Path) -> dict[str, str]:
    own, modules = f"api/{folder.name}/index.md", {}
    rows = []
    for file in sorted(folder.rglob("*.py")):
        parts = file.relative_to(folder).with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        text = ast.get_docstring(ast.parse(file.read_text())) or ""
        if name != "__init__":
            options = "heading_level: 1" + (", members: false" if parts[-1] == "__init__" else "")
            place = f"phd_exp.{folder.name}.{name}"
            modules[f"api/{folder.name}/{name}.md"] = f"::: {place}\n    options: {{{options}}}\n"
            first = text.partition("\n\n")[0].replace("\n", " ")
            rows.append(f"- [`{name}`]({name}.md): {first}")
    about = GLOSSARY if folder.name == "geometry" else OWN_TEXT.format(folder.name)
    return {own: "\n".join([f"# {folder.name}\n", about, *rows, ""])} | modules


def on_config(config: Any) -> Any:
    """Called by MkDocs: puts the pages under `Reference` in the contents."""
    contents: dict[str, list[Any]] = {}
    first, *others = pages()
    for address in others:
        _, package, file = address.split("/")
        contents.setdefault(package, []).append(
            address if file == "index.md" else {file.removesuffix(".md"): address}
        )
    reference = [first, *({package: files} for package, files in contents.items())]
    config.nav = [{"Reference": reference} if "Reference" in entry else entry for entry in config.nav]
    return config


def on_files(files: Files, *, config: Any) -> Files:
    """Called by MkDocs: adds the pages to the files to build."""
    for address, text in pages().items():
        files.append(File.generated(config, address, content=text))
    return files
