from .method import CrossedNetMethod as CrossedNetMethod
from .pairs import ViewPairs as ViewPairs
from .pairs import view_pairs as view_pairs
from .pairs import view_recipe as view_recipe
from .route import CrossedNetRoute as CrossedNetRoute
from .training import CrossedRecipe as CrossedRecipe
from .training import train_crossed_net as train_crossed_net
