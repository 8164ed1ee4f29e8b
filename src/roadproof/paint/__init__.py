"""Paint that could be real: where it may lie, limits on it, how conspicuous it is."""

from roadproof.paint.conspicuousness import Conspicuousness as Conspicuousness
from roadproof.paint.conspicuousness import conspicuousness as conspicuousness
from roadproof.paint.limits import PaintLimits as PaintLimits
from roadproof.paint.site import LaneMark as LaneMark
from roadproof.paint.site import Site as Site
