"""What mkdocs does to the pages of the documentation: navigation, equations, citations, notebooks.

The pages stay plain Markdown that reads well in an editor. Navigation is the list in index.md; equations in blocks of
`math` become MathML, without a script in the browser; `[key]` links to the bibliography; notebooks become pages.
"""

from __future__ import annotations

import base64
import html
import json
import posixpath
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

MATH = re.compile(r"^```math\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ENTRY = re.compile(r"^- \[(.+?)\]\(([^)]+)\)", re.MULTILINE)
KEY = re.compile(r"(?<![\[`\w*])\[([a-z]+(?:19|20)\d\d)\](?!\(|\*)")
SOURCE = re.compile(r"^\*\*\[(\w+)\]\*\*", re.MULTILINE)
TITLED = re.compile(r"^```(\w+) +(\S+)$", re.MULTILINE)
FENCE = re.compile(r"(^```.*?^```$|`[^`\n]+`)", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)")


def on_config(config: Any) -> Any:
    """Take the navigation from the sections of index.md."""
    text = Path(config["docs_dir"], "index.md").read_text(encoding="utf-8")
    nav: list[Any] = [{"Home": "index.md"}]
    for part in text.split("\n\n")[2:]:
        heading, _, rest = part.strip().partition("\n")
        pages = [entry(config, name[:1].upper() + name[1:], page) for name, page in ENTRY.findall(rest)]
        if pages:
            nav.append({heading.rstrip(): pages})
    config["nav"] = nav
    return config


def entry(config: Any, name: str, page: str) -> dict[str, Any]:
    """Return a page of the navigation; the index of a folder with the pages of it."""
    if page.endswith(".ipynb"):
        return {name: f"{page}.md"}
    if not page.endswith("/index.md"):
        return {name: page}
    folder = Path(config["docs_dir"], page).parent
    pages = [f"{folder.name}/{path.name}" for path in sorted(folder.glob("*.md")) if path.name != "index.md"]
    return {name: [page, *pages]}


def on_files(files: Any, config: Any) -> Any:
    """Make a page of every notebook."""
    for path in sorted(Path(config["docs_dir"], "notebooks").glob("*.ipynb")):
        page = File.generated(config, f"notebooks/{path.name}.md", content=notebook(path))
        files.remove(files.get_file_from_path(f"notebooks/{path.name}"))
        files.append(page)
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Put in equations and links."""
    here = posixpath.dirname(page.file.src_uri)
    bibliography = posixpath.relpath("bibliography.md", here or ".")
    titled = TITLED.sub(r'```\1 title="\2"', markdown)
    parts = FENCE.split(MATH.sub(equation, listed(titled)))
    for k in range(0, len(parts), 2):
        parts[k] = KEY.sub(rf"[[\1]]({bibliography}#\1)", parts[k])
        parts[k] = LINK.sub(lambda match: inside(match, here, files), parts[k])
    text = "".join(parts)
    return SOURCE.sub(r'<a id="\1"></a>**[\1]**', text)


def listed(markdown: str) -> str:
    """Return Markdown with a blank line before each list that follows a paragraph: mkdocs needs one."""
    lines: list[str] = []
    fenced = within = False
    for line in markdown.splitlines():
        fenced ^= line.startswith("```")
        item = re.match(r"(- |\d+\. )", line) is not None and not fenced
        if item and not within and lines and lines[-1].strip():
            lines.append("")
        within = item or (within and bool(line.strip()))
        lines.append(line)
    return "\n".join(lines) + "\n"


def equation(match: re.Match[str]) -> str:
    """Return an equation as MathML."""
    rows = [convert(line, display="block") for line in match[1].strip().splitlines() if line.strip()]
    return f'<div class="equation" tabindex="0" role="region" aria-label="Equation">{"".join(rows)}</div>'


def inside(match: re.Match[str], here: str, files: Any) -> str:
    """Return a link within the site; the text alone where it leads to a file of the source."""
    name, target = match.groups()
    path, *_ = target.partition("#")
    if "://" in target or not path:
        return match[0]
    whole = posixpath.normpath(posixpath.join(here, path))
    if path.endswith(".ipynb"):
        return f"[{name}]({path}.md)"
    return match[0] if files.get_file_from_path(whole) else name


def notebook(path: Path) -> str:
    """Return an executed notebook as Markdown."""
    parts: list[str] = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        code = "\n".join(line for line in source.splitlines() if not line.startswith("%"))
        parts.append(f"```python\n{code}\n```")
        parts += [shown(output) for output in cell["outputs"]]
    return "\n\n".join(parts) + "\n"


def shown(output: dict[str, Any]) -> str:
    """Return what a cell shows: a picture, a table, or text."""
    data = output.get("data", {})
    if "image/png" in data:
        picture = "".join(data["image/png"]).strip()
        assert base64.b64decode(picture)
        return f'<img alt="Picture made by the code above" src="data:image/png;base64,{picture}">'
    if "text/html" in data and "<style" not in "".join(data["text/html"]):
        text = "".join(data["text/html"]).replace("\n", "")
        return f'<div class="output" tabindex="0" role="region" aria-label="Output">{text}</div>'
    text = "".join(output.get("text") or data.get("text/plain", ""))
    return f'<pre class="output" tabindex="0">{html.escape(text.rstrip())}</pre>'


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Name the dialog of the search."""
    return output.replace('role="dialog"', 'role="dialog" aria-label="Search"')
