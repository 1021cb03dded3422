"""What MkDocs has to be told of these pages: links that leave docs/, and equations. Loaded by mkdocs.yml, no page.

The pages are written to be read in the repository, too. There a link to ``../slam/ekf.py`` is all that is needed,
and equations stand in ``$…$`` and in fences named ``math``. For the site

- a link to a file outside docs/ becomes one into the repository where ``repo_url`` is set, else the file's path;
  to one of :data:`PAGES` it becomes a link to that page. A file that is not there is a warning, which ends
  ``mkdocs build --strict``, and so is a section that a link asks for and that its page does not have;
- a link that shows a page's file name shows its title;
- equations become MathML, which browsers set by themselves. One that cannot be read is a warning.
"""

from __future__ import annotations

import html
import logging
import posixpath
import re
import unicodedata
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from math_core import LatexError, LatexToMathML
from mkdocs.structure.files import File

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
PAGES = {"README.md": "overview.md", "BENCHMARK.md": "leaderboard.md", "CHANGELOG.md": "changelog.md"}
"""Files of the repository's root that are pages of the site."""
BRANCH = "main"

log = logging.getLogger("mkdocs.hooks.docs")

_FENCE = re.compile(r"^ *(`{3,}|~{3,})")
_CODE = re.compile(r"(`+)(?!`).+?(?<!`)\1(?!`)", re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^()\s]+)\)")
_MATH = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
# What opens, what closes, what parts an equation.
_NESTING = re.compile(r"\\\\|\\[{}]|(\{|\\begin\b|\\left\b)|(\}|\\end\b|\\right\b)|(\\q?quad\b)")
_ROLE = re.compile(r":(?:attr|class|data|func|meth|mod):(?=<code>)")
_SCHEME = re.compile(r"^[a-z][a-z0-9+.-]*:", re.IGNORECASE)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Give headings the anchors that they have in the repository."""
    config.mdx_configs["toc"]["slugify"] = slug
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Make pages of the files of the root that are to be pages."""
    for name, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite the links of a page that leave docs/."""
    uri = page.file.src_uri
    source = next((name for name, made in PAGES.items() if made == uri), f"docs/{uri}")

    def rewrite(image: str, text: str, target: str) -> str:
        path, mark, anchor = target.partition("#")
        if not path or _SCHEME.match(target):
            return f"{image}[{text}]({target})"
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        named = path
        if path in PAGES:
            path = f"docs/{PAGES[path]}"
        if path.startswith("docs/") and not path.endswith(".py"):
            if text in (path, named, posixpath.basename(path), posixpath.basename(named)):
                text = heading(named, anchor) or text
            return f"{image}[{text}]({posixpath.relpath(path, posixpath.dirname(f'docs/{uri}'))}{mark}{anchor})"
        if path.startswith("../") or not (ROOT / path).exists():
            log.warning("%s links to %s, which is not in the repository", source, path)
        if config.repo_url:
            kind = "tree" if (ROOT / path).is_dir() else "blob"
            return f"{image}[{text}]({config.repo_url.rstrip('/')}/{kind}/{BRANCH}/{path}{mark}{anchor})"
        path += "/" * (ROOT / path).is_dir()
        return f"`{path}`" if path.rstrip("/").endswith(text.strip("`/")) else f"{text} (`{path}`)"

    return rewrite_links(markdown, rewrite)


def on_page_content(content: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Set the equations of a page."""

    def mathml(found: re.Match[str]) -> str:
        display, latex = found[1] == "div", html.unescape(found[2]).strip()[2:-2].strip()  # less \( \) or \[ \]
        try:
            made = [to_mathml(part, display) for part in (split_equation(latex) if display else [latex])]
        except LatexError as error:
            log.warning("%s: cannot set the equation %s: %s", page.file.src_uri, latex, error)
            return found[0]
        return f'<div class="equation">{"".join(made)}</div>' if display else made[0]

    return _MATH.sub(mathml, _ROLE.sub("", content).replace(" ::</p>", "</p>"))  # docstrings are no Markdown


def slug(heading: str, separator: str = "-") -> str:
    """Return a heading's anchor as GitHub makes it: letters, digits, hyphens, underscores, in lower case."""
    lower = heading.strip().lower()
    kept = (c for c in lower if c in "-_ " or unicodedata.category(c)[0] in "LM" or c.isdecimal())
    return "".join(kept).replace(" ", separator)


@cache
def heading(path: str, anchor: str = "") -> str:
    """Return a page's title; of the home page, whose title is the site's, the heading of the section asked for."""
    file = ROOT / path
    if not (file.is_file() and file.suffix == ".md"):
        return ""
    prose = "".join(part for is_fence, part in split_fences(file.read_text(encoding="utf-8")) if not is_fence)
    headings = re.findall(r"^#+ +(.*?) *$", prose, re.MULTILINE)
    if path == "docs/index.md" and anchor:
        return next((h for h in headings if slug(h) == anchor), "")
    return str(headings[0]) if headings else ""


@cache
def to_mathml(latex: str, display: bool) -> str:
    """Return an equation as MathML."""
    return LatexToMathML(fancy_error=False).convert_with_local_state(latex, displaystyle=display)


def split_equation(latex: str) -> list[str]:
    """Return the parts of an equation that wide spaces part, so that a narrow page can set them one a line."""
    parts, begin, depth = [], 0, 0
    for found in _NESTING.finditer(latex):
        if found[1]:
            depth += 1
        elif found[2]:
            depth -= 1
        elif found[3] and depth == 0:
            parts.append(latex[begin : found.start()])
            begin = found.end()
    return [part.strip() for part in [*parts, latex[begin:]] if part.strip()]


def rewrite_links(markdown: str, rewrite: Callable[[str, str, str], str]) -> str:
    """Apply ``rewrite(image, text, target)`` to every inline link outside fences and code."""
    return "".join(
        part if is_fence else _rewrite_prose(part, rewrite) for is_fence, part in split_fences(markdown)
    )


def split_fences(markdown: str) -> Iterator[tuple[bool, str]]:
    """Yield the fenced blocks of a page, fences included, and the prose between them."""
    part: list[str] = []
    fence = ""
    for line in markdown.splitlines(keepends=True):
        found = _FENCE.match(line)
        if not fence and found:
            yield False, "".join(part)
            part, fence = [line], found[1]
        elif fence and found and line.strip().startswith(fence) and not line.strip().strip(fence[0]):
            yield True, "".join([*part, line])
            part, fence = [], ""
        else:
            part.append(line)
    yield bool(fence), "".join(part)


def _rewrite_prose(prose: str, rewrite: Callable[[str, str, str], str]) -> str:
    code = [found.span() for found in _CODE.finditer(prose)]

    def one(found: re.Match[str]) -> str:
        if any(begin < found.start() < end for begin, end in code):
            return found[0]
        return rewrite(found[1], found[2], found[3])

    return _LINK.sub(one, prose)
