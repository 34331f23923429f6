"""The documents' generated tables, commands in sentences, links and file names."""

from __future__ import annotations

import re
import shlex

import click
import pytest

from talkcli import __version__
from talkcli.cli.click_app import talk
from talkcli.cli.commands import COMMANDS
from tests.readme import reference
from tests.support.documents import COMMAND_LINE, CONTRIBUTING, DOCUMENTS, INTERNALS, ROOT, Document, code_spans, tables

#: Variables that `talk` sets only for its own processes.
INTERNAL = {"TALK_LIVENESS_FD"}
#: Patterns of code that reads a variable, or that defines a constant with its name.
READ = (
    r'environ(?:ment)?(?:\.get\(|\[)"(\w+)"',
    r'"(\w+)" (?:not )?in (?:\w+\.)?environ',
    r'\benv="(\w+)"',
    r'^[A-Z_]+ = "(TALK_\w+)"',
    r'(?<=[(" ])"(TMPDIR|TEMP|TMP)"',
)
_BEFORE = r"talk (?:--socket \S+ |--robot \S+ |--json |-q )*"


@pytest.mark.parametrize("name", reference.TABLES)
def test_generated_tables_are_current(name: str) -> None:
    """`python -m tests.readme.reference` updates them."""
    document, _ = reference.TABLES[name]
    assert reference.current(name) == document.text


def test_variables_are_in_the_table() -> None:
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "talkcli").rglob("*.py")]
    read = {name for source in sources for form in READ for name in re.findall(form, source, re.MULTILINE)}
    documented = [name for row in tables(COMMAND_LINE.section("Variables"))[0][1:] for name in code_spans(row[0])]
    assert sorted(documented) == sorted(read - INTERNAL)


def test_commands_within_sentences_can_be_parsed() -> None:
    """A `say` without a text gets one, because a sentence may name only the command or an option."""
    form = re.compile(rf"`((?:sudo |ssh robot )?{_BEFORE}([a-z]+)[^`\n]*)`")
    commands = {line for document in DOCUMENTS for line, name in form.findall(document.text) if name in COMMANDS}
    assert len(commands) > 30
    for line in commands:
        name, *arguments = shlex.split(re.sub(f"^.*?{_BEFORE}", "", line.partition(" < ")[0]))
        command = talk.get_command(click.Context(talk), name)
        assert command
        if arguments == ["--ttl"]:  # a sentence names the option without a value
            arguments.append("5")
        if name == "say" and all(part.startswith("--") or part in {"-o", "-f", "-wf"} for part in arguments):
            arguments = ["text"] if arguments in (["-o"], ["-wf"], ["-f"]) else [*arguments, "text"]
        command.make_context(name, arguments, parent=click.Context(talk))


LINK = re.compile(r"\[[^\]]*\]\(([^)]+)\)")
#: A path relative to the project or to the package.
PATH = re.compile(r"`((?:[.\w]+/)+[\w-]+\.(?:py|md|txt|svg))`")
BY_PATH = {document.path: document for document in DOCUMENTS}


def test_every_document_is_tested() -> None:
    folders = (".github", "completions", "talkcli", "tests")
    paths = {ROOT / "README.md", *(path for folder in folders for path in (ROOT / folder).rglob("*.md"))}
    assert paths == set(BY_PATH)


def test_links_and_file_names_are_recognized() -> None:
    assert len({link for document in DOCUMENTS for link in LINK.findall(document.prose)}) > 10
    assert len({path for document in (INTERNALS, CONTRIBUTING) for path in PATH.findall(document.text)}) > 10


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: document.name)
def test_the_target_of_each_link_exists(document: Document) -> None:
    for link in LINK.findall(document.prose):
        if link.startswith("https://"):
            continue
        file, _, anchor = link.partition("#")
        path = (document.path.parent / file).resolve() if file else document.path
        assert path.exists(), link
        assert not anchor or anchor in BY_PATH[path].anchors, link


@pytest.mark.parametrize("document", [INTERNALS, CONTRIBUTING], ids=lambda document: document.name)
def test_files_that_are_named_exist(document: Document) -> None:
    for path in PATH.findall(document.text):
        assert (ROOT / path).exists() or (ROOT / "talkcli" / path).exists(), path


def test_the_test_files_named_in_contributing_exist() -> None:
    """pytest stops if a file in such a command is missing."""
    for pattern in re.findall(r"\btests/[\w/*.]+", CONTRIBUTING.section("Set up, and test")):
        assert any(ROOT.glob(pattern)), pattern


def test_the_changelog_has_a_section_for_this_version() -> None:
    released = re.findall(r"^## (\S+) - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert released[0] == __version__
