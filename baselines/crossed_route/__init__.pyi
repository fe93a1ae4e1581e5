from .carriers import Carriers as Carriers
from .observation import CrossedMeasurement as CrossedMeasurement
from .observation import CrossedObservation as CrossedObservation
from .observation import CrossedReason as CrossedReason
from .observation import Settings as Settings
from .refinement import fringes as fringes
from .route import CrossedRoute as CrossedRoute
