"""Scene 11: upright."""

from hard import scenes as hard


def test_growth_beside_the_upright_equilibrium():
    """Everything, also rounding, grows e-fold each 0.1 s: none may be lost or added."""
    motion = hard.simulate(hard.beside_upright(), hard.TIGHT)
    assert hard.growth_error(motion.q) <= 0.01
