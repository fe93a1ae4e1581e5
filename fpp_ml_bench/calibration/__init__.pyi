from .depth_views import MOST_PX as MOST_PX
from .depth_views import DepthView as DepthView
from .depth_views import view_from_frames as view_from_frames
from .depth_views import view_from_maps as view_from_maps
from .from_depth import DepthFit as DepthFit
from .from_depth import Residual as Residual
from .from_depth import fit_projector as fit_projector
