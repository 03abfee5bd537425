"""The site of `make docs`: its links lead somewhere, its navigation has every page, and it asks no other host."""

import importlib
import posixpath
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from tests.packaging.test_public_surface import PACKAGES
from tests.view.console.browser import chromium

SITE = Path(__file__).resolve().parents[2] / "out" / "site" / "html"

pytestmark = pytest.mark.slow


class Page(HTMLParser):
    """Anchors, links and loaded files of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors = {""}
        self.links: list[str] = []
        self.navigation: list[str] = []
        self.loaded: list[str] = []
        self._depth = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value for name, value in attrs if value is not None}
        self.anchors |= {found[name] for name in ("id", "name") if name in found}
        self._depth += tag == "nav"
        if tag == "a":
            self.links += [found["href"]] if "href" in found else []
            self.navigation += [found["href"]] if "href" in found and self._depth else []
        else:
            self.loaded += [found[name] for name in ("href", "src") if name in found]

    def handle_endtag(self, tag: str) -> None:
        self._depth -= tag == "nav"


@pytest.fixture(scope="module")
def pages() -> dict[str, Page]:
    assert SITE.is_dir(), "run `make docs`"
    return pages_of(SITE)


def pages_of(site: Path) -> dict[str, Page]:
    """Return the pages of a site by path. The page that only a server shows is left out."""
    found = (path for path in site.rglob("*.html") if path.name != "404.html")
    return {path.relative_to(site).as_posix(): Page(path.read_text("utf-8")) for path in found}


def target_of(page: str, link: str) -> tuple[str, str]:
    """Return the path in the site and the anchor that a link leads to."""
    parts = urlsplit(link)
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), unquote(parts.path))) if parts.path else page
    return path, unquote(parts.fragment)


def is_elsewhere(link: str) -> bool:
    """Return true for a link with a scheme or a host."""
    return bool(urlsplit(link).scheme or urlsplit(link).netloc)


def broken_links(site: Path, pages: dict[str, Page]) -> Iterator[str]:
    """Yield links within a site to a file or an anchor that is not there."""
    for page, parsed in pages.items():
        for link in (*parsed.links, *parsed.loaded):
            path, anchor = target_of(page, link)
            if not is_elsewhere(link) and not (
                anchor in pages[path].anchors if path in pages else (site / path).is_file()
            ):
                yield f"{page}: {link}"


def unlisted(pages: dict[str, Page]) -> set[str]:
    """Return the pages that the navigation of the first page lacks."""
    listed = {target_of("index.html", link)[0] for link in pages["index.html"].navigation}
    return pages.keys() - listed


def test_links_lead_to_files_and_anchors(pages: dict[str, Page]) -> None:
    inner = [link for page in pages.values() for link in page.links if not is_elsewhere(link)]
    print(f"{len(pages)} pages, {len(inner)} links")
    assert len(inner) > 1000
    assert list(broken_links(SITE, pages)) == []


def test_the_navigation_has_every_page(pages: dict[str, Page]) -> None:
    assert len(pages) > 140
    assert unlisted(pages) == set()


def test_pages_load_nothing_from_elsewhere(pages: dict[str, Page]) -> None:
    loaded = {link for page in pages.values() for link in page.loaded}
    assert len(loaded) > 20
    assert {link for link in loaded if is_elsewhere(link) and not link.startswith("data:")} == set()


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_on_the_page_of_its_package(package: str, pages: dict[str, Page]) -> None:
    names = {f"{package}.{name}" for name in importlib.import_module(package).__all__ if name != "__version__"}
    assert names - pages[f"docs/api/{package}.html"].anchors == set()


def test_every_command_and_table_of_a_scene_is_there(pages: dict[str, Page]) -> None:
    from haptether.cli.entry import COMMANDS, GROUPS

    commands = {name for name in COMMANDS if name not in GROUPS}
    commands |= {f"{group}-{name}" for group, names in GROUPS.items() for name in names}
    assert commands - pages["docs/options.html"].anchors == set()
    assert {"mastertable", "safetytable", "linksettings", "kalman"} <= pages["docs/keys.html"].anchors


def test_a_browser_asks_no_other_host_and_finds_a_word() -> None:
    assert SITE.is_dir(), "run `make docs`"
    asked: list[str] = []
    with chromium() as browser:
        page = browser.new_page()
        page.on("request", lambda request: asked.append(request.url))
        for path in ("docs/api/haptether.safety.html", "docs/ladder.html", "docs/keys.html", "index.html"):
            page.goto((SITE / path).as_uri())
        page.keyboard.press("Control+k")
        page.keyboard.type("clutch")
        page.get_by_text(re.compile(r"^[1-9]\d* results$")).wait_for()
    assert len(asked) > 20
    assert [url for url in asked if not url.startswith((SITE.as_uri(), "data:", "blob:"))] == []


def test_faults_of_a_site_are_found(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text('<nav><a href="b.html#there">b</a></nav><a href="c.html">c</a><p id="here">')
    (tmp_path / "b.html").write_text('<p id="there"><a href="index.html#here">i</a><a href="#away">a</a>')
    (tmp_path / "c.html").write_text('<img src="none.png"><a href="https://example.org/">e</a><a href="d.html">d</a>')
    pages = pages_of(tmp_path)
    assert sorted(broken_links(tmp_path, pages)) == ["b.html: #away", "c.html: d.html", "c.html: none.png"]
    assert unlisted(pages) == {"c.html", "index.html"}
