"""Drawings of everyday objects: the vocabulary of the small prior's text route, as `ctlev_core.render` draws it."""

from ctlev_core.render.object_drawing import draw_composition, draw_object
from ctlev_core.render.objects import COLOURS, OBJECTS, Part

__all__ = ["COLOURS", "OBJECTS", "Part", "draw_composition", "draw_object"]
