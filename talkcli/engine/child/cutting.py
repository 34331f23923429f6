"""Code that cuts a growing text into parts for the synthesizer.

A part is a sentence if possible, because a synthesizer needs whole sentences for a natural melody. If the player is
about to run out of sound, a part may be a clause or a few words. The language of the text isn't known here, so the
lists of abbreviations and words contain English, German, French and Spanish.

Nothing here reads the clock. All times are arguments, in monotonic seconds.
"""

from __future__ import annotations

import re
import unicodedata

#: If no text arrives for this long, a full stop or similar mark at the end of the text ends the sentence.
_QUIET_S = 0.1
#: If no text arrives for this long and the player is silent, the words so far are spoken.
_LONG_QUIET_S = 1.0
#: If the player has less sound left than this, a clause is spoken before the rest of its sentence has arrived.
_LOW_BUFFER_S = 0.15
#: Minimum length of a clause, and maximum length of a part of a growing text.
_CLAUSE_CHARS, _PART_CHARS = 12, 300
#: How many characters before a dot are searched for an abbreviation.
_ABBREVIATION_CHARS = 24
#: How long to wait for more text before a sentence may end at a mark. `_NEVER` means that the sentence can't end there.
_NO_WAIT, _SHORT_WAIT, _LONG_WAIT, _NEVER = range(4)

_CLOSERS = r"[\"'”’“‘»«›‹)\]}*_~`」』）】》]*"
_WIDE_CLOSERS = r"[\"'”’」』）】》]*"
_LIST_MARK = r"(?:[-*+•–>]|\d{1,3}[.)]|\#{1,6})"
_SENTENCE_END = re.compile(
    rf"(?P<stop>(?<![.!?…])[.!?…]+{_CLOSERS}(?:[ \u00a0\u202f][»›](?=\s|\Z))?)(?=\s|\Z)"
    rf"|(?P<wide_stop>[。！？]+{_WIDE_CLOSERS}|(?<![!?])[!?]+(?=[\u3400-\u9fff]))"
    rf"|(?P<line>\n)(?=[ \t]*(?:\n|{_LIST_MARK}[ \t]|\d{{1,3}}、))"
    rf"|(?P<last_line>\n)(?=[ \t]*(?:{_LIST_MARK}|\d{{1,3}})?\Z)"
)
_CLAUSE_END = re.compile(
    rf"[,;:]{_CLOSERS}(?=\s)|(?<!\d)[,;:]{_CLOSERS}\Z|(?<=\s)[–—](?=\s|\Z)|—(?=[^\W\d])"
    r"|(?<!\d)[，；：、](?=[\s\w“「『《（]|\Z)|[，；：、](?=[\s“「『《（]|[^\W\d])"
)
#: A gap between words. In Chinese, this is the place between two characters. Numbers such as "1 000" have no gap.
_GAP = re.compile(r"(?<=[^\s\d])\s|(?<=\d)\s(?=\s*[^\s\d])|(?<=[\u3000-\u9fff\uff00-\uff60])(?=[\u3400-\u9fff])")
#: Two characters that belong to the same number or flag.
_PAIR = re.compile("\\d[\\d.,:]|[.,:]\\d|[\U0001f1e6-\U0001f1ff]{2}")
_LAST_WORD = re.compile(r"[^\W\d_]*['’]?\Z")
#: Characters that may come between the end of a sentence and the first letter of the next one.
_LEAD = ' \t\r\n\u00a0\u202f\u3000"“„‘‚«»‹›([{*_~—–¿¡-'

#: Matches an abbreviation, or a number with a dot. In the group "never", the dot never ends a sentence. In the other
#: groups, the dot may end a sentence unless a number ("numbered"), a weekday or time zone ("often") or a month
#: ("number") follows, or only if a word that begins sentences follows ("maybe").
_ABBREVIATION = re.compile(
    r"""(?:
    (?P<never>(?:\A|\n)[\s>*_\#-]*\(?\d{1,3}|:\s1|(?<![\w.])(?:
        Mrs?|Ms|Messrs|Dr|Prof|Rev|Hon|Gen|Col|Maj|Capt|Cmdr|Lt|Sgt|Cpl|Sen|Rep|Gov|Pres|Mt|[Ee]\.\s?g|[Ii]\.\s?e|vs
        |[Cc]f|viz|approx|Hrn?|Frl?|Dipl|Fa|Ing|Mag|[Zz]\.\s?B|[Dd]\.\s?h|bzw|[Vv]gl|[Gg]gf|[Ee]vtl|[Ii]n[ck]l|exkl
        |zzgl|sog|bspw|[Cc]a|med|phil|jur|rer|nat|habil|Nr|MM?|Mmes?|Mlles?|Mgr|Pr|Ste|[Pp]\.\s?ex|[Cc]\.-à-d|env|[Aa]v
        |[Bb]d|boul|apr?|Sra|Srta|Sres|Sras|Dra|Dña|Profa|Lic|Arq|Excmo|Gral|Cnel|Avda|[Pp]\.\s?ej|aprox|EE))
    |(?P<numbered>\b\d\d?\.\s\d\d?|(?<![\w.])(?i:
        Nos?|núm|págs?|pp?|vol|figs?|ch|sec|eq|arts?|cap|abb|abs|kap|bd|tab|anm|tel|ext|max|min|jan|feb|mar|apr|jun
        |jul|aug|sept?|oct|okt|nov|dec|dez|ene|abr|ago|dic|janv|févr|juil|déc))
    |(?P<often>(?<![\w.])(?:etc|us[wf]|[ap]\.\s?m))
    |(?P<maybe>(?<![\w./°])(?:(?:[^\W\d_]\.[\s-]?)*(?!(?<=\d\s)[hmgltVW])[^\W\d_]|[vn]\.\s?Chr|EE\.\s?UU|Ph\.D|Inc|Ltd
        |Co|Corp|Bros|[JS]r|St|Ave|Blvd|Rd|Dept|\w*[Ss]tr|Mio|Mrd|Tsd|Std|Min|Sek|Cía|[UV]ds?)
        |(?i:(?<!\bI\s)\bam|\b(?:zum?|im|zur|vom|beim|bis|ab|und|d(?:er|ie|as|e[mns])
        |(?:[mds]?ein|ihr|unser|jed)e?[mnrs]?))\s\d{1,2})
    |(?P<number>\d))\.[^.!?…]?\Z""",
    re.VERBOSE,
)
#: Words that begin a sentence if they are capitalized after an abbreviation.
_STARTER = r"""(?:
    A|Aber|After|Ahora|Al|All|Alle|Allerdings|Alors|Als|Also|Although|Am|An|And|Après|Aquí|As|At|Au|Auch|Auf|Aus
    |Außerdem|Avec|Because|Before|Bei|Bis|Bitte|But|By|Can|Car|Ce|Cela|Ces|Cette|Comment|Como|Con|Could|Cómo|Cuando
    |Da|Danach|Dann|Dans|Das|De|Del|Dem|Den|Der|Des|Desde|Deshalb|Después|Did|Die|Diese[rs]?|Do|Doch|Does|Donc|Dort
    |Du|Eine?[mnrs]?|El|Ella|Elles?|En|Ensuite|Entonces|Er|Es|Est|Est[aeo]s?|Está|Et|Él|For|From|Für|Had|Has|Hasta
    |Hat|Have|Hay|He|Her|Here|Heute|Hier|His|How|However|Hoy|I|Ich|If|Ihre?|Ils?|Im|In|Is|Ist|It|Its|Ja|Je|Jetzt|Kann
    |Kein|La|Las|Later|Le|Les|Let|Leur|Lo|Los|Luego|Mais|Man|Many|Mañana|Maybe|Meine?|Mi|Mit|Mon|Morgen|Most|Muy|My
    |Nach|Nein|Next|Nicht|No|Non|Not|Notre|Nous|Now|Nun|Nur|O|Ob|Oder|On|Only|Or|Oui|Our|Où|Para|Pero|Please|Por|Pour
    |Puis|Quand|Qué|Qui|Se|Seine?|Seit|Ses|She|Si|Sie|Sin|Sind|Sí|So|Some|Son|Still|Su|También|That|The|Their|Then
    |There|These|They|This|Those|To|Today|Tomorrow|Tous|Tout|Trotzdem|Tu|Tú|Um|Una?|Und|Une|Unsere?|Unter|Usted|Über
    |Voici|Von|Vor|Votre|Vous|War|Warum|Was|We|Wenn|Were|What|When|Where|Which|While|Who|Why|Wie|Will|Wir|With|Wo
    |Would|Y|Yes|Yo|You|Your|Zu|Zum)(?![\w.])|(?:L|J|C|N|Qu|Aujourd)['’]"""
#: Matches the text after an abbreviation or a number if the sentence continues.
_REST = {
    "numbered": re.compile(r"\d"),
    "often": re.compile(r"(?:Mon|Tues|Wednes|Thurs|Fri|Satur|Sun)day|(?:East|West)ern|Pacific|[ECMP][SD]?T\b|GMT|UTC"),
    "maybe": re.compile(rf"(?!{_STARTER})", re.VERBOSE),
    "number": re.compile(
        r"(?:J[aä]n(?:uar|ner)|Februar|März|April|Mai|Ju[nl]i|August|(?:Septem|Okto|Novem|Dezem)ber|Jahrhundert)\b"
        r"|(?:Jan|Feb|Apr|Aug|Sept?|Okt|Nov|Dez)\."
    ),
}


class GrowingText:
    """A text that grows while it is spoken part by part.

    It keeps track of how much of the text was passed to the synthesizer.
    """

    def __init__(self, text: str, *, ended: bool, start: int = 0) -> None:
        """Begin to cut the text at the offset `start`."""
        #: the whole text so far, with the sender's offsets
        self.text = text
        #: whether no more text will be added
        self.ended = ended
        #: offset up to which the synthesizer has received the text
        self.position = start
        #: offset up to which the text was searched without finding the end of a sentence
        self._searched = 0
        #: time of the last change to the text; None until the first search for a part
        self._changed_at: float | None = None

    @property
    def finished(self) -> bool:
        """Whether the text is complete and the synthesizer has received all of it."""
        return self.ended and not self.text[self.position :].strip()

    def append(self, text: str, now: float) -> None:
        """Add text at the end, and record the time of the change."""
        if text:
            self.text += text
            self._changed_at = now

    def drop_incomplete(self) -> None:
        """Mark the text as complete, and drop an incomplete sentence at its end.

        Text that was already passed to the synthesizer is kept.
        """
        position = self.position
        while (end := self._find_sentence_end(_LONG_WAIT)) is not None:
            self.position = end
        self.text, self.position, self.ended = self.text[: self.position], position, True

    def take_next_part(self, now: float, buffered_s: float) -> tuple[int, int] | None:
        """Take the next part that can be spoken now. Return the part's start and end, or None.

        If the text is complete, the rest of it is one part. Blanks between parts are skipped.

        Args:
            now: the current time.
            buffered_s: the remaining sound of the player in seconds, 0 if it is silent.

        Returns:
            the start and end of the part in the text. None if it is too early to cut or nothing is left.
        """
        end = self._find_part_end(now, now + buffered_s)
        if end is None:
            return None
        start, self.position = self.position, end
        return start, end

    def skip_to(self, end: int) -> None:
        """Extend the last part up to an offset, where the next part will begin."""
        self.position = max(self.position, end)

    def next_part_at(self, now: float, buffered_s: float) -> float:
        """Return the time at which the next part can be spoken if no more text is added.

        Return infinity if only more text can complete a part. `buffered_s` is the remaining sound of the player.
        """
        silent_at = now + buffered_s
        changed_at = self._changed_at if self._changed_at is not None else now
        times = (changed_at + _QUIET_S, silent_at - _LOW_BUFFER_S, max(changed_at + _LONG_QUIET_S, silent_at))
        for time in (now, *sorted(each for each in times if each > now)):
            if self._find_part_end(time, silent_at) is not None:
                return time
        return float("inf")

    def _find_part_end(self, now: float, silent_at: float) -> int | None:
        """Skip blanks before the next part. Return the part's end, or None if the part can't be spoken yet.

        Args:
            now: the current time.
            silent_at: the time at which the player becomes silent.
        """
        text = self.text
        start = len(text) - len(text[self.position :].lstrip())
        if self.position or not self.ended:
            self.position = start
        if self.ended:
            return len(text) if start < len(text) else None
        if self._changed_at is None:
            self._changed_at = now
        waited = _SHORT_WAIT if now >= self._changed_at + _QUIET_S else _NO_WAIT
        if now >= max(self._changed_at + _LONG_QUIET_S, silent_at):
            waited = _LONG_WAIT
        longest = start + _PART_CHARS
        end = self._find_sentence_end(waited)
        if end is not None and end <= longest:
            return end
        if now >= silent_at - _LOW_BUFFER_S:
            clause = _CLAUSE_END.search(text, start + _CLAUSE_CHARS - 1)
            if clause and clause.end() <= longest and (clause.end() < len(text) or waited):
                return clause.end()
        if len(text) > longest:
            return _find_break(text, start, longest)
        return _find_word_gap(text, start, longest) if waited == _LONG_WAIT else None

    def _find_sentence_end(self, waited: int) -> int | None:
        """Return the end of the next sentence, or None if no sentence counts as complete after this wait.

        `waited` says how long the text has stayed the same. It is one of the constants such as `_SHORT_WAIT`.
        """
        for found in _SENTENCE_END.finditer(self.text, max(self.position, self._searched)):
            self._searched = found.start()
            needed = _required_wait(self.text, self.position, found)
            if needed <= waited:
                return found.start() if "\n" in found.group() else found.end()
            if needed < _NEVER:
                return None
        self._searched = len(self.text)
        return None


def _required_wait(text: str, start: int, mark: re.Match[str]) -> int:
    """Return the constant for the minimum wait before a sentence may end at a mark.

    The sentence begins at `start`, and `mark` is a match of `_SENTENCE_END`. The result is one of the constants
    such as `_SHORT_WAIT`.
    """
    kind, end = mark.lastgroup, mark.end()
    sentence = text[start:end]
    if not re.search(r"\w", sentence[:_PART_CHARS]):
        return _NEVER
    if "\n" in mark.group():
        return _NO_WAIT if kind == "line" else _LONG_WAIT
    if kind == "wide_stop":
        is_quoted = len(re.findall("[“「『（]", sentence)) > len(re.findall("[”」』）]", sentence))
        return _SHORT_WAIT if is_quoted and end == len(text) else _NO_WAIT
    following = len(text) - len(text[end:].lstrip(_LEAD))
    if text[following : following + 1].islower():
        return _NEVER
    dot = mark.start()
    abbreviation = _ABBREVIATION.search(text[max(start, dot - _ABBREVIATION_CHARS) : dot + 2])
    if abbreviation:
        return _required_abbreviation_wait(text, following, str(abbreviation.lastgroup))
    return _NO_WAIT if following < len(text) else _SHORT_WAIT


def _required_abbreviation_wait(text: str, next_start: int, kind: str) -> int:
    """Return the constant for the minimum wait before a sentence may end at an abbreviation.

    `next_start` is the offset of the text after it, and `kind` is the name of its group in `_ABBREVIATION`.
    """
    if kind == "never":
        return _NEVER
    if _LAST_WORD.match(text, next_start):
        return _LONG_WAIT
    return _NEVER if _REST[kind].match(text, next_start) else _NO_WAIT


def _find_word_gap(text: str, start: int, limit: int) -> int | None:
    """Return the offset of the last gap between words before `limit`, if any.

    The text before the gap must not be too short.
    """
    gaps = [each.start() for each in _GAP.finditer(text, start + _CLAUSE_CHARS, limit + 1)]
    return gaps[-1] if gaps else None


def _find_break(text: str, start: int, limit: int) -> int:
    """Return the best offset for breaking a long sentence before `limit`."""
    found = _CLAUSE_END.finditer(text, start + _CLAUSE_CHARS - 1, limit)
    clauses = [each.end() for each in found if each.end() < limit]
    place = clauses[-1] if clauses else _find_word_gap(text, start, limit)
    if place is None:
        place = next((at for at in range(limit, start, -1) if _may_separate(text[at - 1], text[at])), limit)
    return place


def _may_separate(before: str, after: str) -> bool:
    """Return whether a text may be cut between two neighbouring characters.

    Accents, joiners, variation selectors, skin tones and tags belong to the character before them.
    """
    is_joined = before == "\u200d" or unicodedata.category(after) in ("Mn", "Mc", "Me", "Cf", "Sk")
    return not is_joined and not _PAIR.match(before + after)
