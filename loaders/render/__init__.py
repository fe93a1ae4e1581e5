"""The virtual rig: meshes, scene, ray casting, light, sensor, and building the benchmark from
them."""
