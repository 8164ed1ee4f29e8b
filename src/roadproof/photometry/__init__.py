"""From painted to seen colour: what light, film curve, lens and encoding make of paint on the road."""

from roadproof.photometry.fitting import ColourFit as ColourFit
from roadproof.photometry.fitting import FitReport as FitReport
from roadproof.photometry.fitting import fit_colour as fit_colour
from roadproof.photometry.maps import PixelMaps as PixelMaps
from roadproof.photometry.maps import pixel_maps_from_two_paints as pixel_maps_from_two_paints
from roadproof.photometry.responses import AffineResponse as AffineResponse
from roadproof.photometry.responses import FilmResponse as FilmResponse
from roadproof.photometry.responses import Response as Response
from roadproof.photometry.responses import fit_affine as fit_affine
from roadproof.photometry.samples import ColourSamples as ColourSamples
from roadproof.photometry.samples import samples_from_pictures as samples_from_pictures
from roadproof.photometry.transform import ColourTransform as ColourTransform
from roadproof.photometry.transform import RadialShading as RadialShading
