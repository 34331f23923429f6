"""The documents: tables made from the code, commands in sentences, and links that lead somewhere."""

from __future__ import annotations

import re
import shlex

import click
import pytest

from talkcli.cli.click_app import talk
from talkcli.cli.commands import COMMANDS
from tests.readme import reference
from tests.support.documents import COMMAND_LINE, CONTRIBUTING, DOCUMENTS, INTERNALS, ROOT, Document, code_spans, tables

#: Variables that `talk` sets for its own processes.
INTERNAL = {"TALK_LIVENESS_FD"}
#: The ways in which the code reads a variable. A variable of `talk` may also be a constant.
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
    """To update them: `python -m tests.readme.reference`."""
    document, _ = reference.TABLES[name]
    assert reference.current(name) == document.text


def test_variables_are_in_the_table() -> None:
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "talkcli").rglob("*.py")]
    read = {name for source in sources for form in READ for name in re.findall(form, source, re.MULTILINE)}
    documented = [
        variable for row in tables(COMMAND_LINE.section("Variables"))[0][1:] for variable in code_spans(row[0])
    ]
    assert sorted(documented) == sorted(read - INTERNAL)


def test_commands_within_sentences_can_be_parsed() -> None:
    """A command without its text or its goals is a name, and has no option."""
    form = re.compile(rf"`((?:sudo |ssh robot )?{_BEFORE}([a-z]+)[^`\n]*)`")
    commands = {line for document in DOCUMENTS for line, name in form.findall(document.text) if name in COMMANDS}
    assert len(commands) > 30
    for line in commands:
        name, *arguments = shlex.split(re.sub(f"^.*?{_BEFORE}", "", line.partition(" < ")[0]))
        command = talk.get_command(click.Context(talk), name)
        assert command
        if arguments == ["--ttl"]:  # names the option
            arguments.append("5")
        if name == "say" and all(
            argument.startswith("--") or argument in {"-o", "-f", "-wf"} for argument in arguments
        ):
            arguments = ["text"] if arguments in (["-o"], ["-wf"], ["-f"]) else [*arguments, "text"]
        command.make_context(name, arguments, parent=click.Context(talk))


LINK = re.compile(r"\[[^\]]*\]\(([^)]+)\)")
#: A file of the project that a sentence names, from the top or within the package.
PATH = re.compile(r"`((?:[.\w]+/)+[\w-]+\.(?:py|md|txt|svg))`")
BY_PATH = {document.path: document for document in DOCUMENTS}


def test_every_document_is_tested() -> None:
    folders = (".github", "completions", "talkcli", "tests")
    paths = {ROOT / "README.md", *(path for folder in folders for path in (ROOT / folder).rglob("*.md"))}
    assert paths == set(BY_PATH)


def test_links_and_files_are_found() -> None:
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
    """Contributors run these lines, and pytest stops at a file that isn't there."""
    for pattern in re.findall(r"\btests/[\w/*.]+", CONTRIBUTING.section("Set up, and test")):
        assert any(ROOT.glob(pattern)), pattern
