"""The commands that ask the server and show what it says: cancel, status, watch, log, voices, set, pause, resume.

They know no click: plain command lines come here without it. What watching takes is imported for that alone.
"""

from __future__ import annotations

import sys
import time
from functools import partial

from talkcli.cli.command import nearest
from talkcli.cli.show import note, screen, show, show_found, show_json
from talkcli.errors import EXIT_SIGPIPE, TalkError, UnknownGoal
from talkcli.frozen import TYPE_CHECKING
from talkcli.protocol.events import Canceled, unfinished

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Any

    from talkcli.cli.show import Common
    from talkcli.client.client import Client
    from talkcli.goals.goal import Goal, JsonObject

#: Characters of what was heard last that are shown of a goal that is held.
_MAX_SPOKEN = 40


def cancel(options: Common, ids: tuple[str, ...], current: bool, before: str | None, key: str | None) -> None:
    """Cancel what these select, or everything."""
    with options.connect() as client:
        try:
            done = client.cancel(ids or None, current=current, before=before, key=key)
            _show_canceled(done, options)
            if key and not done.canceled and not options.quiet and sys.stderr and sys.stderr.isatty():
                _suggest_key(key, client)
        except UnknownGoal as error:
            _show_canceled(Canceled.from_items(error.items), options)
            raise


def status(options: Common, goal_id: str | None) -> None:
    """Show how the server stands, or one goal."""
    from talkcli.goals.goal import Goal
    from talkcli.terminal.goals import goal_lines, status_lines

    with options.connect() as client:
        found = client.status() if goal_id is None else client.goal(goal_id)

    def lines() -> Iterable[str]:
        now = time.time()
        return goal_lines(found, screen(), now) if isinstance(found, Goal) else status_lines(found, screen(), now)

    show_found(options, [found.to_json()], lines)


def watch(options: Common, words: bool) -> int:
    """Show all goals as they happen, and each word as it is heard, too, if asked for; return the exit code."""
    from talkcli.cli.interrupts import Interrupts, has_reader
    from talkcli.terminal.transcript import Transcript

    if not has_reader():
        return EXIT_SIGPIPE
    transcript = Transcript(full=screen().width is None, words=words)
    # The reader of its output, too, ends it: in `talk watch | head`, the next event may be far.
    with Interrupts(output=True) as interrupts, options.connect(interrupt=interrupts.watched) as client:
        for event in client.events():
            show_found(options, [event.to_json()], partial(transcript.lines, event, screen(), time.time()))
    return interrupts.exit_code


def log(options: Common, count: int) -> None:
    """Show the goals that ended last."""
    from talkcli.terminal.transcript import log_lines

    with options.connect() as client:
        goals = client.log(count)
    show_found(options, (each.to_json() for each in goals), lambda: log_lines(goals, screen(), time.time()))


def voices(options: Common, language: str | None) -> None:
    """Show the engine's voices, or those of a language with its variants."""
    from talkcli.terminal.goals import voice_lines

    with options.connect() as client:
        found = every = client.voices()
    if language:
        from talkcli.engine.protocol import Voice
        from talkcli.engine.voices import languages

        listed = [Voice(str(each.get("id")), _language(each), str(each.get("name"))) for each in every]
        wanted = languages(language, listed)
        found = [each for each in every if _language(each) in wanted]
        if not found:
            raise TalkError(_no_voice(language, every))
    show_found(options, found, lambda: voice_lines(found))


def change(options: Common, **settings: Any) -> None:
    """Change those settings of the server that aren't None, or show them all."""
    from talkcli.terminal.goals import setting_lines

    asked = {name: value for name, value in settings.items() if value is not None}
    with options.connect() as client:
        found = client.set(**asked) if asked else client.settings()
    show_found(options, [found], lambda: [] if asked else setting_lines(found))


def pause(options: Common) -> None:
    """Hold speech."""
    with options.connect() as client:
        held = client.pause()
    from talkcli.terminal.text import printable

    heard = held.spoken[-_MAX_SPOKEN:] if held and held.spoken else ""
    where = f', after "{printable(heard)}"' if heard else ""
    words = f"{printable(held.id)} is held{where}" if held else "nothing is being spoken, and nothing will be"
    _tell(options, held, paused=True, words=f"{words}; 'talk resume' goes on")


def resume(options: Common) -> None:
    """Go on where speech is held."""
    with options.connect() as client:
        goal = client.resume()
    from talkcli.terminal.text import printable

    words = f"speech goes on with {printable(goal.id)}" if goal else "speech goes on"
    _tell(options, goal, paused=False, words=words)


def _show_canceled(done: Canceled, options: Common) -> None:
    for goal in done.canceled:
        if options.json:
            show_json(goal.to_json())
        elif not options.quiet:
            show(goal.id)
    for goal in done.ended:
        if not options.quiet:
            note(f"{goal.id} had ended already: {goal.state.name}")


def _suggest_key(key: str, client: Client) -> None:
    """Where nothing has this key, but something a similar one, tell whoever typed it."""
    from talkcli.terminal.text import printable

    try:
        status = client.status()
    except TalkError:
        return  # what was asked for is done
    near = nearest(key, {each.key for each in unfinished(status) if each.key})
    if near:
        note(f"no goal has the key '{printable(key)}': did you mean '{printable(near)}'?")


def _no_voice(language: str, voices: Iterable[JsonObject]) -> str:
    """Return what is said where no voice speaks a language, which may have been given by its name."""
    from talkcli.engine.voices import is_neural
    from talkcli.terminal.text import printable

    codes = {_language(each): _language(each) for each in voices}
    # "German", "English_(America)": all that speak it are listed by the first part of its code. A neural voice's name
    # is no language's.
    names = {
        str(each.get("name") or "").partition(" ")[0]: _language(each).partition("-")[0]
        for each in voices
        if not is_neural(str(each.get("id")))
    }
    near = nearest(language, names) or nearest(language, codes)
    hint = f"did you mean '{printable({**codes, **names}[near])}'?" if near else "'talk voices' lists all"
    return f"no voice speaks '{printable(language)}': {hint}"


def _language(voice: JsonObject) -> str:
    return str(voice.get("language") or "").lower()


def _tell(options: Common, goal: Goal | None, *, paused: bool, words: str) -> None:
    """Tell what became of speech, and of the goal that was held."""
    if options.json:
        show_json({"paused": paused, "goal": None if goal is None else goal.to_json()})
    elif not options.quiet:
        note(words)
