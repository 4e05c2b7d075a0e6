"""Sentences about one person's motion, taken apart into actions: a small grammar, in which every word must be known.

    sentence   = clause { ("," | "then" | "and" | "before" | ...) clause }
    clause     = action [ ("while" | "as") action ]
    action     = a verb or noun of `motion_words.WORDS`, and beside it, in any order: how often, how long, how fast, how
                 far out, with which limb, in which direction

A word that is not known is an error and never passed over, because a motion that leaves out what the sentence says is
a wrong label.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

from ctlev_core.body.text_to_motion import words
from ctlev_core.body.text_to_motion.clauses import Clause, known_verbs, read_clause
from ctlev_core.body.text_to_motion.words import MotionWord
from data_contracts.errors import DataError

_TOKEN = re.compile(r"[a-z]+(?:'s)?|\d+(?:\.\d+)?|,")


@dataclass(frozen=True)
class Action:
    """One thing that the person does.

    Attributes:
        word: what.
        verb: as the vocabulary has it.
        count: how often, or how many steps; None = not said.
        duration_s: None = not said.
        speed: 1 = ordinary.
        amplitude: 1 = ordinary.
        limbs: "left", "right", "both", or "" for not said.
        directions: keys of a set of `motion_words.DIRECTIONS`' values.
        angle_deg: of a turn; None = not said.
        meanwhile: what the arms and head, or the heading, do at the same time.
    """

    word: MotionWord
    verb: str
    count: int | None = None
    duration_s: float | None = None
    speed: float = 1.0
    amplitude: float = 1.0
    limbs: str = ""
    directions: frozenset[str] = frozenset()
    angle_deg: float | None = None
    meanwhile: Action | None = None


def parse_sentence(sentence: str) -> tuple[Action, ...]:
    """The actions of a sentence, in the order in which they are done.

    Raises:
        DataError: an unknown word (it is named, with the nearest known ones), no action, two actions without a word
            between, or a detail that does not fit to its action.
    """
    where = f"sentence {sentence!r}"
    if not isinstance(sentence, str) or not sentence.strip():
        raise DataError(f"{where}: expected words")
    try:
        clauses = [(link, read_clause(tokens)) for link, tokens in _split(_tokens(sentence))]
        actions = _join(clauses)
    except DataError as error:
        raise DataError(f"{where}: {error}") from None
    if not actions:
        raise DataError(f"{where}: names no action; known: {', '.join(known_verbs())}")
    return tuple(actions)


def _tokens(sentence: str) -> list[str]:
    text = re.sub(r"[.;!:]+(?!\d)", ",", sentence.lower().replace("\N{RIGHT SINGLE QUOTATION MARK}", "'"))
    text = re.sub(r"at the same time|simultaneously", " simultaneously ", text.replace("-", " "))
    rest = _TOKEN.sub(" ", text).split()
    if rest:
        raise DataError(f"{rest[0]!r} is neither a word nor a number")
    tokens = [token.removesuffix("'s") for token in _TOKEN.findall(text)]
    # Before the phrases are looked for, so that "throws a punch" and "shakes his head" are found.
    tokens = [token for token in tokens if token not in words.FILLERS or token == "both"]
    following = [*tokens, ""][1:]
    return [token for token, after in zip(tokens, following, strict=True) if token != "both" or after in words.LIMBS]


def _split(tokens: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Clauses, and the kind of word before each: "then" or "while"."""
    link, clause = "then", []
    for token in tokens:
        if token not in words.SEQUENCE_WORDS + words.WHILE_WORDS:
            clause.append(token)
            continue
        if (token == "after" and clause) or (token == "before" and not clause and link == "then"):
            raise DataError(f"{token!r} here turns the order round; say it in the order in which it is done")
        if clause:
            yield link, clause
            link, clause = "then", []
        if token in words.WHILE_WORDS:
            link = "while"
    if clause:
        yield link, clause


def _join(clauses: list[tuple[str, Clause]]) -> list[Action]:
    """Clauses without a verb go to the one before ("looks left and right"), or after at the start."""
    joined: list[tuple[str, Clause]] = []
    waiting: Clause | None = None
    for link, clause in clauses:
        if clause.word is None and joined:
            _merge(joined[-1][1], clause)
        elif clause.word is None:
            waiting = _merge(waiting, clause) if waiting else clause
        else:
            joined.append((link, _merge(clause, waiting) if waiting else clause))
            waiting = None
    if waiting is not None:
        raise DataError(f"names no action; known: {', '.join(known_verbs())}")
    return _in_time(joined)


def _in_time(clauses: list[tuple[str, Clause]]) -> list[Action]:
    """Actions one after the other; those that are done at the same time are combined."""
    actions: list[Action] = []
    at_once: Action | None = None
    for link, clause in clauses:
        action = _action(clause)
        if link == "while" and not actions:
            # "While walking, he waves."
            at_once = action
        elif at_once is not None:
            actions.append(_combine(action, at_once))
            at_once = None
        elif actions and (link == "while" or clause.simultaneous):
            actions[-1] = _combine(actions[-1], action)
        elif clause.simultaneous and len(clauses) == 1:
            raise DataError("at the same time as what?")
        else:
            actions.append(action)
    if at_once is not None:
        raise DataError(f"'while' and {at_once.verb!r}, but nothing that is done meanwhile")
    return actions


def _merge(clause: Clause, more: Clause) -> Clause:
    for name, value in more.values.items():
        if name in ("speed", "amplitude"):  # factors, of verbs as well
            clause.values[name] = clause.values.get(name, 1.0) * value
        elif clause.values.setdefault(name, value) != value:
            raise DataError(f"{clause.verb!r} has two values of {name.removesuffix('_s')}; expected one")
    clause.limbs |= more.limbs
    clause.limb_kind = clause.limb_kind or more.limb_kind
    clause.directions |= more.directions
    clause.simultaneous |= more.simultaneous
    return clause


def _check_limbs(clause: Clause, word: MotionWord) -> None:
    verb = clause.verb
    if word.motion == "raise_arm" and clause.limb_kind != "arm":
        raise DataError(f"{verb!r} needs an arm, a hand, or both")
    if clause.limb_kind and clause.limb_kind != word.limb:
        raise DataError(f"{verb!r} does not know what to do with {clause.limb_kind}s")
    if len(clause.limbs) > 1 or "both" in clause.limbs:
        if word.keys_side and word.motion != "raise_arm":
            raise DataError(f"{verb!r} is done with one {word.limb}; say left, right, or neither")
    elif clause.limbs and word.motion == "punch":
        raise DataError(f"{verb!r} is done with both arms in turn; say neither left nor right")


def _action(clause: Clause) -> Action:
    """The action of a clause, its details checked."""
    word, verb = clause.word, clause.verb
    assert word is not None  # `_join` keeps clauses with a verb alone
    _check_limbs(clause, word)
    wrong = sorted(clause.directions - set(word.directions))
    if wrong:
        raise DataError(f"{verb!r} cannot go {wrong[0]!r}; possible: {', '.join(word.directions) or 'no direction'}")
    if clause.directions >= {"forward", "backward"} or (
        clause.directions >= {"left", "right"} and word.motion != "look"
    ):
        raise DataError(f"{verb!r} cannot go {' and '.join(sorted(clause.directions))} at once")
    if "angle_deg" in clause.values and word.kind != "turn":
        raise DataError(f"{verb!r} does not know what to do with degrees")
    values = clause.values
    if "count" in values and word.kind == "gait":
        raise DataError(f"{verb!r} is not done so many times; say for how many steps or seconds")
    count = values.get("count", values.get("steps"))
    if count is not None and word.kind in ("posture", "rise", "stand"):
        raise DataError(f"{verb!r} cannot be counted; say for how long")
    if count is not None and "duration_s" in values:
        raise DataError(f"{verb!r} has a count and a duration; expected one of them")
    return Action(
        word=word,
        verb=verb,
        count=None if count is None else int(count),
        duration_s=values.get("duration_s"),
        speed=values.get("speed", 1.0),
        amplitude=values.get("amplitude", 1.0),
        limbs="both" if len(clause.limbs) > 1 else next(iter(clause.limbs), ""),
        directions=frozenset(clause.directions),
        angle_deg=values.get("angle_deg"),
    )


def _combine(base: Action, added: Action) -> Action:
    """Two actions at the same time: legs from one, arms and head or the heading from the other."""
    if base.word.kind == "arms" and added.word.kind != "arms":
        base, added = added, base
    if base.meanwhile is not None:
        raise DataError(f"{added.verb!r} would be the third thing at the same time; two are possible")
    if base.word.posture == "prone" and added.word.limb == "arm":
        raise DataError(f"{base.verb!r} needs the hands, so {added.verb!r} cannot be done at the same time")
    turning = added.word.kind == "turn" and base.word.kind == "gait"
    if turning or (added.word.kind == "arms" and base.word.kind in ("gait", "step", "stand", "turn", "posture")):
        return replace(base, meanwhile=added)
    raise DataError(
        f"{base.verb!r} and {added.verb!r} cannot be done at the same time; possible is a gait, standing, sitting or "
        f"turning with something that the arms or the head do, or a gait with a turn"
    )
