"""Each link of a document, and each file that it names for developers, leads somewhere."""

from __future__ import annotations

import re

import pytest

from tests.support.documents import CONTRIBUTING, DOCUMENTS, HOUSE, ROOT, Document

LINK = re.compile(r"\[[^\]]*\]\(([^)]+)\)")
#: A file of the project that a sentence names, from the top or within the package.
PATH = re.compile(r"`((?:[.\w]+/)+[\w-]+\.(?:py|md|txt|svg))`")
BY_PATH = {each.path: each for each in DOCUMENTS}


def test_every_document_is_tested() -> None:
    folders = (".github", "completions", "talkcli", "tests")
    found = {ROOT / "README.md", *(each for folder in folders for each in (ROOT / folder).rglob("*.md"))}
    assert found == set(BY_PATH)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda each: each.name)
def test_links_lead_somewhere(document: Document) -> None:
    for link in LINK.findall(document.prose):
        if link.startswith("https://"):
            continue
        file, _, anchor = link.partition("#")
        path = (document.path.parent / file).resolve() if file else document.path
        assert path.exists(), link
        assert not anchor or anchor in BY_PATH[path].anchors, link


@pytest.mark.parametrize("document", [HOUSE, CONTRIBUTING], ids=lambda each: each.name)
def test_files_that_are_named_exist(document: Document) -> None:
    for path in PATH.findall(document.text):
        assert (ROOT / path).exists() or (ROOT / "talkcli" / path).exists(), path
