from .method import CrossedNetMethod as CrossedNetMethod
from .route import CrossedNetRoute as CrossedNetRoute
from .training import CrossedRecipe as CrossedRecipe
from .training import train_crossed_net as train_crossed_net
