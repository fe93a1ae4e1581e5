"""crossed-net: a network decides what one crossed frame leaves open; the depth itself is computed
(docs/phase_and_order.md)."""
