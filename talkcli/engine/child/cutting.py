"""Decides where a text that grows while it is spoken is cut into parts for the synthesizer.

A part is a sentence if possible, because a synthesizer needs whole sentences for a natural melody. If the player is
about to run out of sound, a part may be a clause or a few words. The language of the text isn't known here, so the
lists of abbreviations and words contain English, German, French and Spanish.

Nothing here reads the clock. All times are arguments, in monotonic seconds.
"""

from __future__ import annotations

import re
import unicodedata

#: Time without new text after which a stop at the end of the text ends a sentence.
_QUIET_S = 0.1
#: Time without new text after which a silent player gets the words that are there.
_LONG_QUIET_S = 1.0
#: Remaining sound at which a clause is spoken without waiting for its sentence.
_LOW_BUFFER_S = 0.15
#: Shortest clause, and longest part of a text that still grows.
_CLAUSE_CHARS, _PART_CHARS = 12, 300
#: How far to look for the letter after a stop, and for the abbreviation before it.
_LEAD_CHARS, _ABBREVIATION_CHARS = 32, 24
#: What has to pass before a stop may be taken for the end of a sentence.
_NOTHING, _QUIET, _LONG_QUIET, _NEVER = range(4)

_CLOSERS = r"[\"'”’“‘»«›‹)\]}*_~`」』）】》]*"
_WIDE_CLOSERS = "[\"'”’」』）】》]*"
_LIST_MARK = r"(?:[-*+•–>]|\d{1,3}[.)]|\#{1,6})"
_SENTENCE_END = re.compile(
    rf"(?P<stop>(?<![.!?…])[.!?…]+{_CLOSERS}(?:[ \u00a0\u202f][»›](?=\s|\Z))?)(?=\s|\Z)"
    rf"|(?P<wide_stop>[。！？]+{_WIDE_CLOSERS}|[!?]+(?=[\u3400-\u9fff]))"
    rf"|(?P<line>\n)(?=[ \t]*(?:\n|{_LIST_MARK}[ \t]|\d{{1,3}}、))"
    rf"|(?P<last_line>\n)(?=[ \t]*(?:{_LIST_MARK}|\d{{1,3}})?\Z)"
)
_CLAUSE_END = re.compile(
    rf"[,;:]{_CLOSERS}(?=\s)|(?<!\d)[,;:]{_CLOSERS}\Z|(?<=\s)[–—](?=\s|\Z)|—(?=[^\W\d])"
    r"|(?<!\d)[，；：、](?=[\s\w“「『《（]|\Z)|[，；：、](?=[\s“「『《（]|[^\W\d])"
)
#: A gap between words. In Chinese, it is the place between two characters. Numbers such as "1 000" have no gap.
_GAP = re.compile(
    r"(?<=[^\s\d])\s|(?<=\d)\s(?=\s*[^\s\d])|(?<=[\u3000-\u303f\u3400-\u9fff\uff00-\uff60])(?=[\u3400-\u9fff])"
)
_LEAD = re.compile(r"[\s\"“„‘‚«»‹›(\[{*_~—–¿¡-]*")
_NEXT_WORD = re.compile(r"[^\W\d_]*['’]?")
_BLANKS = re.compile(r"\s*")
_SPOKEN = re.compile(r"\w")
_QUOTES = (("“", "”"), ("「", "」"), ("『", "』"), ("（", "）"))


def _any_of(words: str) -> str:
    return "|".join(words.split())


#: Abbreviations that are followed by the rest of the sentence.
_TITLES = """
    Mrs? Ms Messrs Dr Prof Rev Hon Gen Col Maj Capt Cmdr Lt Sgt Cpl Sen Rep Gov Pres Mt Hrn? Frl? Dipl Ing Mag
    MM? Mmes? Mlles? Mgr Pr Ste Sra Srta Sres Sras Dra Dña Profa Lic Arq EE Excmo Gral Cnel Avda
"""
_WITHIN = r"""
    e\.\s?g i\.\s?e z\.\s?B d\.\s?h p\.\s?ex p\.\s?ej c\.-à-d vs cf viz approx aprox bzw vgl ggf evtl inkl exkl zzgl
    incl sog bspw ca env av bd boul apr ap med phil jur rer nat habil nr
"""
#: Abbreviations that need a number.
_NUMBERED = """
    No Nos núm págs? pp? vol figs? ch sec eq arts? cap abb abs kap bd tab anm tel ext max min mind
    jan feb mar apr jun jul aug sept? oct okt nov dec dez ene abr ago dic janv févr juil déc
"""
#: Abbreviations that may end a sentence, but only before a word that begins one.
_MAYBE_LAST = r"""
    (?:[^\W\d_]\.[\s-]?)*(?!(?<=\d\s)[hmgltVW])[^\W\d_] [vn]\.\s?Chr EE\.\s?UU J\.-C Ph\.D
    Inc Ltd Corp Co Bros Jr Sr St Ave Blvd Rd Dept Str [^\W\d_]+str Mio Mrd Tsd Std Min Sek Cía Uds? Vds?
"""
#: Abbreviations that end a sentence before any capitalized word, except one that belongs to a time.
_OFTEN_LAST = r"etc usw usf [ap]\.\s?m"
_ORDINAL = (
    r"(?:(?<!\bI\s)\bam|\b(?:im|zum|zur|vom|beim|bis|ab|und|d(?:er|ie|as|em|en|es)|(?:[mds]?ein|ihr|unser|jed)e?[mnrs]?))"
    r"\s\d{1,2}"
)
_ABBREVIATION = re.compile(
    rf"(?:(?P<never>(?:\A|\n)[\s>*_#-]*\(?\d{{1,3}}|:\s1|(?<![\w.])(?:{_any_of(_TITLES)}|(?i:{_any_of(_WITHIN)}))|\bM)"
    rf"|(?P<numbered>(?<![\w.])(?i:{_any_of(_NUMBERED)}))|(?P<often>(?<![\w.])(?:{_any_of(_OFTEN_LAST)}))"
    rf"|(?P<maybe>(?<![\w.])(?:{_any_of(_MAYBE_LAST)})|{_ORDINAL})|(?P<day>(?<![\w.,])\d{{1,2}}))\.\Z"
)
_MONTHS = """
    Januar Jänner Februar März April Mai Juni Juli August September Oktober November Dezember Jahrhundert Weltkrieg
""".split()
_TIME_WORDS = frozenset(
    """
    Monday Tuesday Wednesday Thursday Friday Saturday Sunday Eastern Central Pacific Mountain Greenwich
    EST EDT ET CST CT MST PST PDT PT GMT UTC BST CET CEST
    """.split()
)
#: Words that begin sentences, and that don't follow an abbreviation within a sentence if they are capitalized.
_STARTERS = frozenset(
    """
    The A An I You He She It We They This That These Those There Here My Your His Her Its Our Their And But Or So Then
    Now If When While After Before Because As At In On For From To With By Is Are Was Were Do Does Did Can Could Will
    Would Should Must Have Has Had Let Please Yes No Not What Who Where Why How Which All Some Many Most Each Both
    Also However Still Just Only Once Since Although Next Later Today Tomorrow Yesterday Meanwhile Finally
    Der Die Das Den Dem Des Ein Eine Einen Einem Einer Ich Du Er Sie Es Wir Ihr Man Mein Meine Dein Deine Sein Seine
    Unser Unsere Ihre Diese Dieser Dieses Und Aber Oder Doch Denn Dann Danach Da Dort Hier Heute Morgen Gestern Jetzt
    Nun Auch Nur Noch Schon Wenn Als Weil Ob Wie Was Wer Wo Wann Warum Bitte Ja Nein Nicht Kein Keine Im Am An Auf Aus
    Bei Mit Nach Von Vor Zu Zum Zur Für Über Unter Durch Gegen Um Bis Seit Ist Sind War Hat Haben Kann Können Soll
    Sollen Muss Alle Viele Trotzdem Deshalb Allerdings Außerdem Später
    Le La Les L' Un Une Du De J' Je Tu Il Elle On Nous Vous Ils Elles Ce C' Cet Cette Ces Cela Ça Mon Ma Mes Son Sa
    Ses Notre Votre Leur Et Mais Ou Donc Or Car Puis Alors Ensuite Après Avant Si Quand Comme Pour Par Dans En Sur
    Sous Avec Sans Chez Oui Non Ne N' Qui Que Qu' Quoi Où Comment Pourquoi Est Au Aux Tout Tous Aussi Ici Là Voici
    Voilà Aujourd' Demain Hier Enfin Merci
    El Los Las Lo Una Unos Unas Yo Tú Él Ella Usted Ud Nosotros Ellos Ellas Este Esta Estos Estas Esto Ese Esa Eso Mi
    Su Sus Y Pero O Sí Ni Qué Cuando Cuándo Como Cómo Donde Dónde Por Para Con Sin Del Al Desde Hasta Entre Sobre Es
    Son Está Hay Ha Fue Era Se Luego Después Entonces Ahora Hoy Mañana Ayer Aquí Ahí También Además Todo Todos Cada Muy
    Más Ya
    """.split()
)


class GrowingText:
    """A text that grows while it is spoken, and the position up to which it was passed to the synthesizer."""

    def __init__(self, text: str, *, ended: bool) -> None:
        #: the whole text so far, with the sender's offsets
        self.text = text
        #: whether no more text will be added
        self.ended = ended
        self._position = 0
        #: offset before which the text contains no end of a sentence after the position
        self._searched = 0
        #: time of the last change; None until it is known
        self._changed_at: float | None = None

    @property
    def finished(self) -> bool:
        """Whether the text has ended and all of it was passed on."""
        return self.ended and self._skip_blanks() == len(self.text)

    def append(self, text: str, now: float) -> None:
        """Add text at the end."""
        if text:
            self.text += text
            self._changed_at = now

    def end(self) -> None:
        """Declare the text complete."""
        self.ended = True

    def drop_incomplete(self) -> None:
        """End the text after its last complete sentence, because the producer broke off.

        Text that was already passed on stays.
        """
        position = self._position
        while (end := self._find_sentence_end(_LONG_QUIET)) is not None:
            self._position = end
        self.text, self._position, self.ended = self.text[: self._position], position, True

    def next_part(self, now: float, buffered: float) -> tuple[int, int] | None:
        """Return the start and end of the next part, and move the position behind it.

        A text that has ended is one part. Blanks between parts are skipped.

        Args:
            now: The current time.
            buffered: The remaining sound of the player in seconds, 0 if it is silent.

        Returns:
            Offsets in the text, or None if it is too early to cut or nothing is left.
        """
        end = self._find_end(now, now + buffered)
        if end is None:
            return None
        start, self._position = self._position, end
        return start, end

    def due(self, now: float, buffered: float) -> float:
        """Return the time at which there is a next part even if no text is added, or infinity."""
        silent_at = now + buffered
        changed_at = self._changed_at if self._changed_at is not None else now
        times = (changed_at + _QUIET_S, silent_at - _LOW_BUFFER_S, max(changed_at + _LONG_QUIET_S, silent_at))
        for time in (now, *sorted(each for each in times if each > now)):
            if self._find_end(time, silent_at) is not None:
                return time
        return float("inf")

    def _skip_blanks(self) -> int:
        """Return the offset of the first character that isn't blank after the position."""
        found = _BLANKS.match(self.text, self._position)
        return found.end() if found else self._position

    def _find_end(self, now: float, silent_at: float) -> int | None:
        """Return the end of the next part at a time, given the time at which the player becomes silent."""
        text, start = self.text, self._skip_blanks()
        if self.ended:
            return len(text) if start < len(text) else None
        self._position = start
        if self._changed_at is None:
            self._changed_at = now
        passed = _QUIET if now >= self._changed_at + _QUIET_S else _NOTHING
        if now >= max(self._changed_at + _LONG_QUIET_S, silent_at):
            passed = _LONG_QUIET
        longest = start + _PART_CHARS
        end = self._find_sentence_end(passed)
        if end is not None and end <= longest:
            return end
        if now >= silent_at - _LOW_BUFFER_S:
            clause = _CLAUSE_END.search(text, start + _CLAUSE_CHARS - 1)
            if clause and clause.end() <= longest and (clause.end() < len(text) or passed):
                return clause.end()
        if len(text) > longest:
            return _find_break(text, start, longest)
        return _find_gap(text, start, longest) if passed == _LONG_QUIET else None

    def _find_sentence_end(self, passed: int) -> int | None:
        """Return the end of the first sentence after the position, given what has passed since the last change."""
        for found in _SENTENCE_END.finditer(self.text, max(self._position, self._searched)):
            self._searched = found.start()
            needed = _judge(self.text, self._position, found)
            if needed <= passed:
                return found.start() if "\n" in found.group() else found.end()
            if needed < _NEVER:
                return None
        self._searched = len(self.text)
        return None


def _judge(text: str, start: int, found: re.Match[str]) -> int:
    """Return what has to pass before a sentence that began at `start` may end here."""
    kind, end = found.lastgroup, found.end()
    if not _SPOKEN.search(text, start, end):
        return _NEVER
    if kind == "line":
        return _NOTHING
    if kind == "last_line":
        return _LONG_QUIET
    if kind == "wide_stop":
        is_quoted = any(text.count(left, start, end) > text.count(right, start, end) for left, right in _QUOTES)
        return _QUIET if is_quoted and end == len(text) else _NOTHING
    lead = _LEAD.match(text, end, end + _LEAD_CHARS)
    following = lead.end() if lead else end
    if text[following : following + 1].islower():
        return _NEVER
    abbreviation = None
    if found.group().startswith(".") and not found.group().startswith(".."):
        abbreviation = _ABBREVIATION.search(text[max(start, found.start() - _ABBREVIATION_CHARS) : found.start() + 1])
    if abbreviation:
        return _judge_abbreviation(text, following, abbreviation.lastgroup)
    return _NOTHING if following < len(text) else _QUIET


def _judge_abbreviation(text: str, following: int, kind: str | None) -> int:
    """Return what has to pass before a sentence may end after an abbreviation or a number, given what follows."""
    if kind == "never":
        return _NEVER
    if kind == "numbered" and following < len(text):
        return _NEVER if text[following].isdecimal() else _NOTHING
    found = _NEXT_WORD.match(text, following)
    word, end = (found.group().replace("’", "'"), found.end()) if found else ("", following)
    is_complete = end < len(text)
    if kind == "day":
        is_ordinal = word in _MONTHS if is_complete else any(each.startswith(word) for each in _MONTHS)
        return (_NEVER if is_complete else _LONG_QUIET) if is_ordinal else _NOTHING
    if not is_complete:
        return _LONG_QUIET
    if kind == "often":
        return _NEVER if word in _TIME_WORDS else _NOTHING
    is_starter = text[end] != "." and (word in _STARTERS or word.rstrip("'") in _STARTERS)
    return _NOTHING if is_starter else _NEVER


def _find_gap(text: str, start: int, longest: int) -> int | None:
    """Return the offset of the last gap between words, or None if the words before it are too short."""
    gaps = [each.start() for each in _GAP.finditer(text, start + _CLAUSE_CHARS, longest + 1)]
    return gaps[-1] if gaps else None


def _find_break(text: str, start: int, longest: int) -> int:
    """Return the best place to break a sentence that is too long."""
    found = _CLAUSE_END.finditer(text, start + _CLAUSE_CHARS - 1, longest)
    clauses = [each.end() for each in found if each.end() < longest]
    place = clauses[-1] if clauses else _find_gap(text, start, longest)
    if place is None:
        place = next((at for at in range(longest, start, -1) if _may_separate(text[at - 1], text[at])), longest)
    return place


def _may_separate(before: str, after: str) -> bool:
    """Return whether two neighbouring characters may go to different parts."""
    joined = (
        unicodedata.category(after)[0] == "M" or "\u200d" in (before, after) or "\U0001f3fb" <= after <= "\U0001f3ff"
    )
    tags_or_flags = "\U000e0020" <= after <= "\U000e007f" or (
        before >= "\U0001f1e6" and "\U0001f1e6" <= after <= "\U0001f1ff"
    )
    number = (before.isdecimal() or after.isdecimal()) and all(
        each.isdecimal() or each in ".,:" for each in before + after
    )
    return not (joined or tags_or_flags or number)
