"""The vector formulas of docs/theory.md equal the printed equations."""

import numpy as np

import fdof_jax as fj


def random_case(seed):
    rng = np.random.default_rng(seed)
    linkage = fj.Linkage(
        "RPR", length=rng.uniform(0.3, 2, 4), com=rng.normal(size=(3, 2)),
        mass=rng.uniform(0.5, 2, 3), inertia=rng.uniform(0.1, 1, 3), base_angle=0.4,
    )  # fmt: skip
    return linkage, rng.normal(size=6), rng.normal(size=6)


def vectors(linkage, x):
    """Returns e, c and d as complex numbers, mu, s and J, by the link's number."""
    angle = np.array([0, linkage.base_angle, *x[1::2]])
    slide = np.array([0, *x[0::2], 0])
    e = np.exp(1j * angle)
    d = np.array([0, *(np.asarray(linkage.length) + 1j * slide[1:])]) * e
    c = np.array([0, 0, *(np.asarray(linkage.com) @ [1, 1j])]) * e
    m = np.array([0, 0, *linkage.mass])
    mu = np.array([m[n:].sum() for n in range(len(m) + 1)])
    s = m * c + mu[1:] * d
    J = np.array([0, 0, *linkage.inertia]) + m * abs(c) ** 2 + mu[1:] * abs(d) ** 2
    return e, c, d, m, mu, s, J


def dot(a, b):
    return (a * np.conj(b)).real


def test_the_mass_matrix():
    linkage, x, _ = random_case(0)
    e, _, d, _, mu, s, J = vectors(linkage, x)
    B, th = {1: 0, 2: 2, 3: 4}, {2: 1, 3: 3, 4: 5}
    M = np.zeros((6, 6))
    for n in (1, 2, 3):
        M[B[n], B[n]] = mu[n + 1]
        for k in range(n + 1, 5):
            M[B[n], th[k]] = dot(e[n], s[k])
            if k < 4:
                M[B[n], B[k]] = mu[k + 1] * dot(e[n], e[k])
    for n in (2, 3, 4):
        M[th[n], th[n]] = J[n]
        for k in range(n + 1, 5):
            M[th[n], th[k]] = dot(d[n], s[k])
            if k < 4:
                M[th[n], B[k]] = mu[k + 1] * dot(d[n], e[k])
    for n in (2, 3):
        M[th[n], B[n]] = mu[n + 1] * linkage.length[n - 1]
    M = M + M.T - np.diag(np.diag(M))
    np.testing.assert_allclose(fj.paper.mass_matrix(linkage, x), M, rtol=1e-13)


def test_velocities_and_gravity():
    linkage, x, xd = random_case(1)
    e, c, d, m, *_ = vectors(linkage, x)
    w, v = np.array([0, 0, *xd[1::2]]), np.array([0, *xd[0::2]])
    carried = lambda n: w[n] ** 2 * d[n] + 2 * w[n] * v[n] * e[n]
    f = np.zeros(5, complex)
    for k in (2, 3, 4):
        before = sum(carried(n) for n in range(2, k))
        f[k] = m[k] * (w[k] ** 2 * c[k] + before - 1j * linkage.gravity)
    beyond = [f[n + 1 :].sum() for n in range(5)]
    phi = []
    for n in (1, 2, 3):
        phi.append(dot(1j * e[n], beyond[n]))
        own = dot(1j * c[n + 1], f[n + 1])
        phi.append(own + dot(1j * d[n + 1], beyond[n + 1]))
    np.testing.assert_allclose(fj.paper.bias_force(linkage, x, xd), phi, rtol=1e-12)


def test_the_recursion_for_any_number_of_joints():
    topology, rng = "RPRRP", np.random.default_rng(3)
    linkage = fj.Linkage(
        topology, length=rng.uniform(0.3, 2, 6), com=rng.normal(size=(5, 2)),
        mass=rng.uniform(0.5, 2, 5), inertia=rng.uniform(0.1, 1, 5),
        locked=rng.normal(size=5), base_angle=0.4,
    )  # fmt: skip
    q = rng.normal(size=5)
    x, _ = fj.paper.to_chain(linkage, q, q)
    e, _, d, _, mu, s, J = vectors(linkage, x)
    first, second = np.zeros(8, complex), np.zeros(8)
    for n in reversed(range(2, 7)):
        first[n] = s[n] + first[n + 1]
        second[n] = J[n] + 2 * dot(d[n], first[n + 1]) + second[n + 1]
    turns = dict(enumerate((joint == "R" for joint in topology), start=1))
    M = np.zeros((5, 5))
    for k in range(1, 6):
        p = first[k + 1] if turns[k] else mu[k + 1] * e[k]
        h = second[k + 1] if turns[k] else dot(first[k + 1], e[k])
        for i in reversed(range(1, k + 1)):
            if i < k:
                h = h + dot(d[i + 1], p)
            M[i - 1, k - 1] = M[k - 1, i - 1] = h if turns[i] else dot(e[i], p)
    np.testing.assert_allclose(fj.mass_matrix(linkage, q), M, rtol=1e-13)
