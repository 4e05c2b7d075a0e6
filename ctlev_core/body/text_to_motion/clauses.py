"""The words of one clause about motion, such as "kicks twice with the left leg": what each of them says."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field
from functools import cache

from ctlev_core.body.text_to_motion import words
from ctlev_core.body.text_to_motion.words import MAX_COUNT, MotionWord
from data_contracts.errors import DataError


@dataclass
class Clause:
    """What the words of a clause say.

    Attributes:
        word: the action; None where no word names one.
        verb: as the vocabulary has it.
        values: `count`, `steps`, `duration_s`, `speed`, `amplitude` and `angle_deg`, as far as they are said.
        limbs: of "left", "right" and "both".
        limb_kind: "arm" or "leg", or empty.
        directions: values of `motion_words.DIRECTIONS`.
        simultaneous: "at the same time" is said.
        number: read, and not yet known what it counts.
        exponent: of "very" and its like, for the word that follows.
    """

    word: MotionWord | None = None
    verb: str = ""
    values: dict[str, float] = field(default_factory=dict)
    limbs: set[str] = field(default_factory=set)
    limb_kind: str = ""
    directions: set[str] = field(default_factory=set)
    simultaneous: bool = False
    number: float | None = None
    exponent: float = 1.0


def read_clause(tokens: list[str]) -> Clause:
    """What the words of a clause say.

    Raises:
        DataError: an unknown word (it is named, with the nearest known ones), two actions, or a number out of range.
    """
    clause, at = Clause(), 0
    while at < len(tokens):
        token, following = tokens[at], tokens[at + 1] if at + 1 < len(tokens) else ""
        phrase = () if _is_unit(clause, token) else _match_phrase(tokens[at:])
        if phrase:
            _take_verb(clause, phrase, token)
        elif not (
            _take_measure(clause, token) or _take_manner(clause, token) or _take_place(clause, token, following)
        ) and (_lemmas().get(token) not in words.LIGHT_VERBS):
            raise DataError(_unknown(token))
        at += max(1, len(phrase))
    if clause.number is not None:
        _set(clause, "count", clause.number, MAX_COUNT)
    return clause


def _is_unit(clause: Clause, token: str) -> bool:
    """A step is the unit of a gait in "walks three steps", and an action elsewhere."""
    gait = clause.word is not None and clause.word.kind == "gait"
    return clause.number is not None and (token in words.UNITS or (gait and token in ("step", "steps")))


def _take_measure(clause: Clause, token: str) -> bool:
    """Numbers, and what they count."""
    if token in words.NUMBERS or token[0].isdigit():
        clause.number = float(words.NUMBERS.get(token, 0) or token)
    elif token in words.COUNTS:
        _set(clause, "count", words.COUNTS[token], MAX_COUNT)
    elif clause.number is not None and _is_unit(clause, token):
        name, largest = words.UNITS.get(token, ("steps", MAX_COUNT))
        _set(clause, name, clause.number, largest)
        clause.number = None
    else:
        return False
    return True


def _take_manner(clause: Clause, token: str) -> bool:
    """How fast, how far out, and what else is done."""
    for name, table in (("speed", words.SPEEDS), ("amplitude", words.AMPLITUDES)):
        if token in table:
            clause.values[name] = clause.values.get(name, 1.0) * table[token] ** clause.exponent
            clause.exponent = 1.0
            return True
    if token in words.INTENSIFIERS:
        clause.exponent *= words.INTENSIFIERS[token]
    elif token == "simultaneously":
        clause.simultaneous = True
    else:
        return False
    return True


def _take_place(clause: Clause, token: str, following: str) -> bool:
    """Limbs and directions; "left" is one or the other."""
    if token in ("left", "right", "both") and following in words.LIMBS:
        clause.limbs.add(token)
    elif token in words.LIMBS:
        clause.limb_kind = words.LIMBS[token].rstrip("s")
        if words.LIMBS[token].endswith("s") and not clause.limbs:
            clause.limbs.add("both")
        # "One hand" and "two hands" are no counts of the action.
        clause.number = None if clause.number in (1, 2) else clause.number
    elif token in words.DIRECTIONS:
        clause.directions.add(words.DIRECTIONS[token])
    else:
        return False
    return True


def _match_phrase(tokens: list[str]) -> tuple[str, ...]:
    """The longest phrase of the vocabulary that the tokens begin with."""
    lemmas = tuple(_lemmas().get(token, token) for token in tokens[:3])
    return next((lemmas[:n] for n in range(len(lemmas), 0, -1) if lemmas[:n] in _phrases()), ())


def _take_verb(clause: Clause, phrase: tuple[str, ...], token: str) -> None:
    verb = " ".join(phrase)
    if clause.word is not None:
        raise DataError(f"{token!r} follows {clause.verb!r} without 'then', 'and' or 'while' between")
    clause.word, clause.verb = _phrases()[phrase], verb
    clause.values["speed"] = clause.values.get("speed", 1.0) * words.SPEED_OF_VERB.get(verb, 1.0)


def _set(clause: Clause, name: str, value: float, largest: float) -> None:
    if not 0 < value <= largest or (name in ("count", "steps") and value != int(value)):
        whole = "a whole number, " if name in ("count", "steps") else ""
        raise DataError(f"{value:g} {name.partition('_')[0]}: expected {whole}more than 0 and at most {largest:g}")
    clause.values[name] = value


def _unknown(token: str) -> str:
    near = difflib.get_close_matches(token, _known_words(), n=3, cutoff=0.6)
    nearest = f" (nearest known: {', '.join(near)})" if near else ""
    return f"unknown word {token!r}{nearest}; known actions: {', '.join(known_verbs())}"


def known_verbs() -> list[str]:
    """Every verb and noun of the vocabulary, uninflected, sorted."""
    return sorted(" ".join(phrase) for phrase in _phrases())


@cache
def _phrases() -> dict[tuple[str, ...], MotionWord]:
    return {tuple(phrase.split()): word for word in words.WORDS for phrase in word.phrases}


@cache
def _lemmas() -> dict[str, str]:
    """Base form of each inflected word of a phrase, and of each light verb."""
    bases = {part for phrase in _phrases() for part in phrase} | set(words.LIGHT_VERBS)
    lemmas = {form: base for base in sorted(bases) for form in words.forms_of(base)}
    # "lay" is a verb of its own and a form of "lie": what is a base form stays one.
    return {**lemmas, **{base: base for base in bases}}


@cache
def _known_words() -> tuple[str, ...]:
    tables = (words.SPEEDS, words.AMPLITUDES, words.INTENSIFIERS, words.DIRECTIONS, words.LIMBS, words.NUMBERS)
    known = set(_lemmas()).union(words.COUNTS, words.SEQUENCE_WORDS, words.WHILE_WORDS, *tables)
    return tuple(sorted(known))
