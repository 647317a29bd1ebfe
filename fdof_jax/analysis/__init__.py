"""Analysis of configurations and motions: equilibria, linearisation, reactions."""
