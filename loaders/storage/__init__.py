"""The dataset format on disk: Arrow shards, manifest, reading, verifying, Parquet."""
