from .networks import build as build
from .networks.model import load as load
