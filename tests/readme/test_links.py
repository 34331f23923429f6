"""What the documents point at is there: each link, and each file that is named for developers; and all are known."""

from __future__ import annotations

import re

import pytest

from tests.support.documents import CONTRIBUTING, DOCUMENTS, HOUSE, README, ROOT, Document

LINK = re.compile(r"\[([^\]]*)\]\(([^)]+)\)")
#: A file of the project, as it is named in a sentence: from the top, or within the package.
PATH = re.compile(r"`((?:[.\w]+/)+[\w-]+\.(?:py|md|txt|svg))`")
BY_PATH = {each.path: each for each in DOCUMENTS}


def test_all_documents_are_known() -> None:
    folders = (".github", "completions", "talkcli", "tests")
    found = {ROOT / "README.md", *(each for folder in folders for each in (ROOT / folder).rglob("*.md"))}
    assert found == set(BY_PATH)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda each: each.name)
def test_links_lead_somewhere(document: Document) -> None:
    for _, link in LINK.findall(document.prose):
        if link.startswith("https://"):
            continue
        file, _, anchor = link.partition("#")
        path = (document.path.parent / file).resolve() if file else document.path
        assert path.exists(), link
        assert not anchor or anchor in BY_PATH[path].anchors, link


def test_links_are_found() -> None:
    assert len(LINK.findall(README.prose)) > 15


def test_readme_names_what_it_links_to() -> None:
    """Where it is shown without the files beside it, as on PyPI, the reader sees what to look for."""
    for words, link in LINK.findall(README.prose):
        assert link.startswith(("#", "https://", ".github/picture/")) or words == link, link


@pytest.mark.parametrize("document", [HOUSE, CONTRIBUTING], ids=lambda each: each.name)
def test_files_that_are_named_are_there(document: Document) -> None:
    named = PATH.findall(document.text)
    assert len(named) > 10
    for path in named:
        assert (ROOT / path).exists() or (ROOT / "talkcli" / path).exists(), path


def test_readme_is_short() -> None:
    assert len(README.text.splitlines()) <= 600
