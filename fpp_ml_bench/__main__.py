"""``python -m fpp_ml_bench`` is ``fpp-bench``."""

from fpp_ml_bench.commands import main

if __name__ == "__main__":
    raise SystemExit(main())
