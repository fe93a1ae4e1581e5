"""crossed-net: what one crossed frame leaves open, learned; the depth itself is computed (docs/crossed.md)."""
