"""Training a recipe: losses, objectives, one engine, its log and its checkpoint."""
