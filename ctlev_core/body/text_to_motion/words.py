"""The words that `motion_sentences.py` understands: data only, apart from the forms of a verb."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["gait", "step", "turn", "whole", "arms", "posture", "rise", "stand"]
Posture = Literal["standing", "seated", "kneeling", "prone", "supine"]


@dataclass(frozen=True)
class MotionWord:
    """A motion that can be asked for in words.

    Attributes:
        motion: name in `keyframes.MOTIONS` or `EVERYDAY_MOTIONS`.
        kind: gaits go on and on; a whole-body motion is done so many times; `arms` leave the legs to another motion.
        phrases: verbs and nouns for it, uninflected.
        count: how often it is done where the sentence does not say.
        limb: what a side in the sentence may refer to.
        keys_side: the side that the key poses use.
        directions: what the sentence may add.
        posture: of the body during and after it.
    """

    motion: str
    kind: Kind
    phrases: tuple[str, ...]
    count: int = 1
    limb: Literal["arm", "leg", ""] = ""
    keys_side: Literal["left", "right", ""] = ""
    directions: tuple[str, ...] = ()
    posture: Posture = "standing"


MAX_COUNT = 100
MAX_DURATION_S = 120.0

_GAIT = ("forward", "backward", "left", "right", "around", "circle")
_WALK = (*_GAIT, "sideways", "in place")
_STEP = ("forward", "backward", "left", "right", "sideways", "in place")
_TURN = ("left", "right", "around", "backward")

WORDS = (
    MotionWord("walk", "gait", ("walk", "stroll", "pace", "wander", "amble"), directions=_WALK),
    MotionWord("run", "gait", ("run", "jog", "sprint", "dash"), directions=(*_GAIT, "in place")),
    MotionWord("march", "gait", ("march",), directions=(*_GAIT, "in place")),
    MotionWord("crawl", "gait", ("crawl",), directions=_GAIT, posture="prone"),
    MotionWord("walk", "step", ("step",), directions=_STEP),
    MotionWord("side_step", "step", ("sidestep", "side step"), directions=("left", "right")),
    MotionWord("step_in_place", "turn", ("turn", "rotate", "pivot"), directions=_TURN),
    MotionWord("spin", "whole", ("spin", "twirl", "pirouette"), directions=("left", "right", "around", "circle")),
    MotionWord("jump", "whole", ("jump", "leap"), directions=("forward", "backward", "up", "down", "in place")),
    MotionWord("hop", "whole", ("hop",), 3, "leg", "left", ("forward", "backward", "up", "down", "in place")),
    MotionWord("jumping_jack", "whole", ("jump jack", "star jump"), 3),
    MotionWord("kick", "whole", ("kick",), 1, "leg", "left", ("forward",)),
    MotionWord("spin_kick", "whole", ("spin kick", "roundhouse kick"), 1, "leg", "right"),
    MotionWord("punch", "whole", ("punch", "throw punch"), 1, "arm", "", ("forward",)),
    MotionWord("throw", "whole", ("throw", "toss", "hurl"), 1, "arm", "right", ("forward",)),
    MotionWord("squat", "whole", ("squat", "crouch"), directions=("down",)),
    MotionWord("lunge", "whole", ("lunge",), 1, "leg", "left", ("forward",)),
    MotionWord("bow", "whole", ("bow", "bend", "bend over"), directions=("forward", "down")),
    MotionWord("dance", "whole", ("dance",), 2, directions=("around",)),
    MotionWord("stretch", "whole", ("stretch",)),
    MotionWord("cartwheel", "whole", ("cartwheel",), directions=("left", "right")),
    MotionWord("pick_up", "whole", ("pick up", "pick"), directions=("up",)),
    MotionWord("push_up", "whole", ("push up", "pushup", "press up"), 3, posture="prone"),
    MotionWord("sit_up", "whole", ("sit up", "situp", "crunch"), 3, posture="supine"),
    MotionWord("wave", "arms", ("wave", "greet"), 4, "arm", "left"),
    MotionWord("clap", "arms", ("clap", "applaud"), 6, "arm"),
    MotionWord("raise_arm", "arms", ("raise", "lift"), 1, "arm", "left", ("up",)),
    MotionWord("point", "arms", ("point",), 1, "arm", "left", ("forward",)),
    MotionWord("drink", "arms", ("drink", "sip"), 1, "arm", "right"),
    MotionWord("look", "arms", ("look", "glance"), directions=("left", "right", "around")),
    MotionWord("nod", "arms", ("nod",), 2),
    MotionWord("shake_head", "arms", ("shake head",), 2),
    MotionWord("sit_down", "posture", ("sit", "seat"), directions=("down",), posture="seated"),
    MotionWord("kneel", "posture", ("kneel",), 1, "leg", "right", ("down",), posture="kneeling"),
    MotionWord("lie_down", "posture", ("lie", "lay"), directions=("down", "backward"), posture="supine"),
    MotionWord("sit_down", "rise", ("stand up", "rise")),
    MotionWord("lie_down", "rise", ("get up",)),
    MotionWord("stand", "stand", ("stand", "wait", "stop", "pause", "idle"), directions=("in place",)),
)

SPEED_OF_VERB = {"stroll": 0.8, "amble": 0.7, "pace": 0.9, "jog": 0.85, "sprint": 1.35, "dash": 1.3}

IRREGULAR = {
    "run": ("ran", "running"), "sit": ("sat", "sitting"), "stand": ("stood",), "throw": ("threw", "thrown"),
    "bend": ("bent",), "kneel": ("knelt",), "spin": ("spun", "spinning"), "lie": ("lay", "lying", "lain"),
    "lay": ("laid",), "drink": ("drank",), "leap": ("leapt",), "get": ("got", "getting"), "rise": ("rose", "risen"),
    "shake": ("shook", "shaken"), "hop": ("hopped", "hopping"), "jog": ("jogged", "jogging"),
    "clap": ("clapped", "clapping"), "nod": ("nodded", "nodding"), "squat": ("squatted", "squatting"),
    "step": ("stepped", "stepping"), "sip": ("sipped", "sipping"), "stop": ("stopped", "stopping"),
    "begin": ("began", "begun", "beginning"), "take": ("took", "taken"), "do": ("did", "does", "doing", "done"),
    "make": ("made",), "go": ("went", "goes", "going"), "give": ("gave",), "keep": ("kept",), "come": ("came",),
    "sidestep": ("sidestepped", "sidestepping"),
}  # fmt: skip

FILLERS = {
    "a", "an", "the", "this", "that", "his", "her", "their", "its", "my", "your", "is", "are", "was", "were", "be",
    "to", "with", "in", "on", "at", "of", "from", "onto", "into", "for", "off", "by", "it", "i", "he", "she", "they",
    "who", "himself", "herself", "itself", "themselves", "again", "there", "now", "also", "just", "still", "upright",
    "both", "toward", "towards", "someone", "somebody", "person", "people", "man", "woman", "human", "guy", "boy",
    "girl", "child", "kid", "lady", "adult", "figure", "character", "body", "air", "hello", "goodbye", "hi", "me",
    "camera", "front", "ball", "box", "object", "something", "thing", "things", "stone", "water", "coffee", "tea",
    "cup", "glass", "bottle", "can", "chair", "bench", "sofa", "floor", "ground",
}  # fmt: skip
"""Words without a part in the motion: subjects, articles, prepositions, objects that are not drawn."""

LIGHT_VERBS = (
    "start", "begin", "continue", "keep", "do", "perform", "take", "make", "give", "go", "come", "get", "use",
)  # fmt: skip
"""Verbs that leave the action to the next word: "starts walking", "takes a step"."""

SPEEDS = {
    "slowly": 0.65, "slow": 0.65, "leisurely": 0.75, "gently": 0.8, "carefully": 0.75, "calmly": 0.85, "briskly": 1.25,
    "quickly": 1.35, "quick": 1.35, "fast": 1.4, "rapidly": 1.45, "hurriedly": 1.35, "faster": 1.4, "slower": 0.65,
    "normally": 1.0, "steadily": 1.0,
}  # fmt: skip
AMPLITUDES = {"high": 1.25, "deeply": 1.15, "deep": 1.15, "widely": 1.15, "slightly": 0.7, "low": 0.75}
INTENSIFIERS = {"very": 1.6, "really": 1.6, "quite": 1.2, "rather": 1.0, "fairly": 1.0, "more": 1.0}
"""Exponents of the speed or amplitude that follows."""

DIRECTIONS = {
    "forward": "forward", "forwards": "forward", "ahead": "forward", "straight": "forward", "backward": "backward",
    "backwards": "backward", "back": "backward", "left": "left", "right": "right", "around": "around",
    "round": "around", "circle": "circle", "circles": "circle", "place": "in place", "spot": "in place", "up": "up",
    "upward": "up", "upwards": "up", "down": "down", "leftward": "left", "rightward": "right", "sideways": "sideways",
    "behind": "around",
}  # fmt: skip

LIMBS = {
    "hand": "arm", "arm": "arm", "fist": "arm", "hands": "arms", "arms": "arms", "leg": "leg", "foot": "leg",
    "knee": "leg", "legs": "legs", "feet": "legs",
}  # fmt: skip

NUMBERS = {
    "one": 1, "two": 2, "three": 3, "four": 4, "five": 5, "six": 6, "seven": 7, "eight": 8, "nine": 9, "ten": 10,
    "eleven": 11, "twelve": 12, "thirteen": 13, "fourteen": 14, "fifteen": 15, "twenty": 20, "thirty": 30,
}  # fmt: skip
UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), ("duration_s", MAX_DURATION_S)),
    **dict.fromkeys(("degree", "degrees"), ("angle_deg", 3600.0)),
    **dict.fromkeys(("time", "times"), ("count", MAX_COUNT)),
}
"""What a number counts, and how much is possible."""
COUNTS = {"once": 1, "twice": 2, "thrice": 3}

SEQUENCE_WORDS = (",", "then", "and", "next", "finally", "afterwards", "afterward", "before", "followed", "after")
WHILE_WORDS = ("while", "as", "whilst")


def forms_of(word: str) -> set[str]:
    """The inflected forms of a verb, or the plural of a noun; impossible forms do no harm."""
    stem = word.removesuffix("e")
    forms = {word, word + "s", stem + "ing", stem + "ed", *IRREGULAR.get(word, ())}
    if word.endswith(("s", "sh", "ch", "x", "ss")):
        forms.add(word + "es")
    return forms
