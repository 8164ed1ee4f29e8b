"""From a pattern to the frames a camera would have recorded with it on the road."""

from roadproof.compositing.composite import Compositor as Compositor
from roadproof.compositing.composite import composite as composite
from roadproof.compositing.composite import covered_share as covered_share
from roadproof.compositing.variation import Variation as Variation
from roadproof.compositing.view import CanvasView as CanvasView
from roadproof.compositing.view import view_canvas as view_canvas
