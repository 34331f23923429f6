"""The examples on the page about talking with people, with a server that plays nothing in real time."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

from tests.readme.blocks import block, runs
from tests.support.surroundings import needs

if TYPE_CHECKING:
    from tests.readme.shell import Shell
    from tests.support.processes import Talk

#: Changes of the examples, so that the model prints its prompt, lets the person interrupt before the first word of the
#: second answer, and can fail.
_CHANGES = {
    "In Python": {
        "    for word": "    print(history)\n    while len(history) == 3 > len(said): time.sleep(0.01)\n    for word",
        "        yield": '        assert said[-1] != "fail" or word != "9", "no model"\n        yield',
    },
    "A dialogue": {
        "    for word": "    print(history)\n    while len(history) == 3: await asyncio.sleep(0.01)\n    for word",
        "        yield word": '        assert history[-1]["content"] != "fail" or word != "9", "no model"\n'
        "        yield word",
    },
}


@pytest.fixture
def speaking(soundless: Talk) -> Talk:
    return soundless


def wait_for_word(talk: Talk, answer: str) -> str:
    """Wait for the fifth word of an answer, and return the goal's id."""
    event = talk.watcher.wait_until(
        lambda event: event.get("number") == 5 and talk.goal(event["id"])["text"].startswith(answer)
    )
    return str(event["id"])


@runs("In Python", "A dialogue")
@pytest.mark.parametrize("name", _CHANGES)
def test_the_history_of_a_dialogue_contains_what_was_heard(speaking: Talk, name: str) -> None:
    talk = speaking
    code = block(name)
    for old, new in _CHANGES[name].items():
        assert code.count(old) == 1
        code = code.replace(old, new)
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    command = [sys.executable, "-uc", code]
    with ExitStack() as stack:
        dialogue = stack.enter_context(subprocess.Popen(command, env=talk.env, text=True, bufsize=1, **pipes))
        stack.callback(dialogue.kill)  # if an assertion fails
        assert dialogue.stdin
        assert dialogue.stdout

        def history() -> list[tuple[str, str]]:
            assert dialogue.stdout
            return [(each["role"], each["content"]) for each in ast.literal_eval(dialogue.stdout.readline())]

        def heard(goal_id: str) -> list[tuple[str, str]]:
            goal = talk.goal(goal_id)
            return [("assistant", goal["text"][: goal["spoken_end"]])] if goal["spoken_end"] else []

        dialogue.stdin.write("hello\n")
        assert history() == [("user", "hello")]
        goal_id = wait_for_word(talk, "You said: hello.")
        dialogue.stdin.write("wait\n")
        talk.watcher.wait_for_terminal(goal_id)
        first = [("user", "hello"), *heard(goal_id)]
        assert history() == first
        words = [word["word"] for word in talk.watcher.words(goal_id)]
        assert re.findall(r"\w+", first[1][1]) in (words, words[:-1])  # the last word may have been interrupted
        assert history() == [*first, ("user", "wait")]  # the next prompt
        dialogue.stdin.write("next\n")
        assert history() == [*first, ("user", "wait")]  # interrupted before the first word
        third = [*first, ("user", "wait"), ("user", "next")]
        assert history() == third
        goal_id = wait_for_word(talk, "You said: next.")
        assert talk.run("say", "--preempt", "--", "other").code == 0
        third += history()[4:]
        assert third[4:] == heard(goal_id) != []
        dialogue.stdin.write("fail\n")
        assert history() == [*third, ("user", "fail")]
        assert dialogue.stdout.readline() == "the model or the server failed: no model\n"
        assert history() == [*third, ("user", "fail"), *heard(talk.watcher.goals()[-1])]
        assert talk.goal(talk.watcher.goals()[-1])["reason"] == "broken_off"
        assert dialogue.communicate(timeout=20) == ("", None)
        assert dialogue.returncode == 0


@runs("In the shell")
def test_the_shell_prints_what_was_heard(speaking: Talk, shell: Shell) -> None:
    needs("jq")
    shell.program("answer", "exec bash -c '" + block("In the shell").replace("'", "'\\''") + '\' answer "$1"')
    shell.program("llm", 'echo "You said: $1. One two three."; exit "${code:-0}"')
    for code in ("0", "3"):
        done = shell.run("answer hello", code=code)
        assert (done.returncode, done.stdout) == (int(code), "You said: hello. One two three.\n")
    shell.program("llm", "while :; do echo one two; done")
    running = shell.start("answer hello")
    goal_id = wait_for_word(speaking, "one two")
    assert speaking.run("cancel", "--key", "dialogue").code == 0
    out, _ = running.communicate(timeout=20)
    goal = speaking.goal(goal_id)
    assert (running.returncode, out) == (7, goal["text"][: goal["spoken_end"]] + "\n")


@runs("Listen while the robot is silent")
def test_speech_continues_after_the_end_of_a_listener(speaking: Talk) -> None:
    goal_id = speaking.request("say", text="one two three four five six seven eight nine ten")["goal"]["id"]
    speaking.watcher.wait_for_word(goal_id)
    command = [sys.executable, "-c", block("Listen while the robot is silent")]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, env=speaking.env, **pipes) as listener:
        assert listener.stdout
        assert listener.stdout.read(2) == b"> "
        assert speaking.goal(goal_id)["paused"] is True
        listener.kill()
        assert speaking.watcher.wait_for_terminal(goal_id) == "SUCCEEDED"


@runs("Listen while the robot is silent #2")
def test_the_shell_gets_the_answer_of_a_listener(speaking: Talk, shell: Shell) -> None:
    shell.program("listen", "talk --json status | grep -o '\"paused\": true'; exit 3", directory=shell.directory)
    done = shell.run(block("Listen while the robot is silent #2") + 'code=$?; echo "$answer" $code')
    assert done.stdout == '"paused": true 3\n'
    assert not speaking.request("status")["server"]["paused"]


@runs("Was that for me?")
def test_a_pause_ends_after_the_decision(speaking: Talk, shell: Shell) -> None:
    for code, state in ((0, "PREEMPTED"), (1, "SUCCEEDED")):
        shell.program("was-that-for-me", f"talk status > status; exit {code}", directory=shell.directory)
        goal_id = speaking.request("say", text="one two three four five six", key="dialogue")["goal"]["id"]
        speaking.watcher.wait_for_word(goal_id)
        shell.run(block("Was that for me?"))
        assert speaking.watcher.wait_for_terminal(goal_id) == state
        assert "speech is paused" in (shell.directory / "status").read_text("utf-8")
        assert not speaking.request("status")["server"]["paused"]


@runs("Excuse me")
def test_a_sentence_continues_after_another_one(speaking: Talk, shell: Shell) -> None:
    done = shell.run(block("Excuse me"))
    assert done.returncode == 0, done
    first, aside = speaking.watcher.goals()
    assert speaking.watcher.wait_for_terminal(first) == "SUCCEEDED"
    states = [(event["id"], event["state"]) for event in speaking.watcher.events() if event["event"] == "state"]
    assert states[3:] == [(aside, "ACTIVE"), (aside, "SUCCEEDED"), (first, "ACTIVE"), (first, "SUCCEEDED")]
    words = [event["word"] for event in speaking.watcher.words(first)]
    assert words == re.findall(r"\w+", speaking.goal(first)["text"])
