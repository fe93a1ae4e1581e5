"""The design of crossed fringes: which periods and angles leave one order."""
