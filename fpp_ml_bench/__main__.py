"""``python -m fpp_ml_bench`` is ``fpp-bench``."""

from fpp_ml_bench.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
