from __future__ import annotations

import numpy as np
import pytest

from slam.geometry import compose, relative, wrap
from slam.graph.matching import Links
from slam.graph.pose_graph import PoseGraph, relative_jacobians
from slam.graph.window import Window, moved
from tests.slam.numerics import numerical_jacobian, random_covariance

Array = np.ndarray


def test_jacobians_of_relative_poses_and_of_motions() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = rng.normal(0, 2, (2, 3))
        _, by_first, by_second = relative_jacobians(a[None], b[None])
        seen_by = numerical_jacobian(lambda p, b=b: relative(p[None], b[None])[0], a, angle=2)
        seen_at = numerical_jacobian(lambda p, a=a: relative(a[None], p[None])[0], b, angle=2)
        np.testing.assert_allclose(by_first[0], seen_by, atol=1e-6)
        np.testing.assert_allclose(by_second[0], seen_at, atol=1e-6)
        _, by_pose, by_motion = moved(a, b)
        np.testing.assert_allclose(
            by_pose, numerical_jacobian(lambda p, b=b: compose(p, b), a, angle=2), atol=1e-6
        )
        at_motion = numerical_jacobian(lambda p, a=a: compose(a, p), b, angle=2)
        np.testing.assert_allclose(by_motion, at_motion, atol=1e-6)


def random_graph(rng: np.random.Generator, n: int) -> PoseGraph:
    """A chain with more links, some of them flat in a direction and with a gradient, all nearly consistent."""
    true = np.cumsum(rng.normal(0, 0.5, (n, 3)), axis=0)
    graph = PoseGraph(true[0], 1e-4 * np.eye(3))
    for k in range(1, n):
        graph.add_node(true[k] + rng.normal(0, 0.02, 3))
    pairs = [(k, k + 1) for k in range(n - 1)] + [tuple(rng.choice(n, 2, replace=False)) for _ in range(n)]
    for k, (i, j) in enumerate(pairs):
        info = np.linalg.inv(random_covariance(3, rng, 1e-3))
        if k >= n and k % 2:
            normal = rng.normal(0, 1, 3)
            info = 1e3 * np.outer(normal, normal)  # of one wall
        z = relative(true[i][None], true[j][None])[0]
        graph.add_link(int(i), int(j), z, info, info @ rng.normal(0, 0.01, 3))
    return graph


def dense(graph: PoseGraph, poses: Array) -> tuple[float, Array, Array]:
    """Loss, gradient and Gauss-Newton information by finite differences of every link's own residual."""
    n = graph.size
    prior_root = np.linalg.cholesky(graph._prior_info).T

    def residuals(flat: Array) -> Array:
        p = flat.reshape(-1, 3)
        out = [prior_root @ (p[0] - graph._prior)]
        for k in range(graph.links):
            (i, j), h, g = graph._ends[k], graph._h[k], graph._g[k]
            values, vectors = np.linalg.eigh(h)
            kept = values > 1e-9 * values.max()
            root = np.sqrt(values[kept])[:, None] * vectors[:, kept].T
            off = relative(p[i][None], p[j][None])[0] - graph._z[k]
            off[2] = wrap(off[2])
            out.append(root @ off + (vectors[:, kept].T @ g) / np.sqrt(values[kept]))
        return np.concatenate(out)

    r = residuals(poses.ravel())
    j = numerical_jacobian(residuals, poses.ravel().copy())
    assert j.shape[1] == 3 * n
    return float(r @ r), j.T @ r, j.T @ j


def test_sparse_solution_and_marginals_are_the_dense_ones() -> None:
    rng = np.random.default_rng(1)
    graph = random_graph(rng, 9)
    _, gradient, information = dense(graph, graph.poses)
    g, h = graph.gradient_and_information()
    np.testing.assert_allclose(g, gradient, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(h.toarray(), information, rtol=1e-5, atol=1e-2)
    poses = graph.poses.copy()
    for _ in range(20):
        _, gradient, information = dense(graph, poses)
        poses = poses - np.linalg.solve(information, gradient).reshape(-1, 3)
    graph.solve(iterations=20, tolerance=1e-12)
    np.testing.assert_allclose(relative(graph.poses, poses), 0.0, atol=1e-7)
    cov = np.linalg.inv(dense(graph, graph.poses)[2])
    part = [6, 7, 8, 18, 19, 20]
    graph._factor = None  # linearised at the solution, not a step before
    np.testing.assert_allclose(graph.covariance([2, 6]), cov[np.ix_(part, part)], rtol=1e-4, atol=1e-9)


def test_a_closing_that_contradicts_all_else_is_scaled_down_and_can_be_dropped() -> None:
    graph = PoseGraph(np.zeros(3), 1e-6 * np.eye(3))
    for k in range(1, 30):
        graph.add_node(np.array([float(k), 0.0, 0.0]))
        graph.add_link(k - 1, k, np.array([1.0, 0.0, 0.0]), np.diag([1e4, 1e4, 1e6]))
    graph.solve()
    before, links = graph.poses.copy(), graph.links
    graph.add_link(0, 29, np.zeros(3), 1e4 * np.eye(3), closing=0)  # "back at the start", 29 m off
    graph.solve(iterations=15)
    assert np.abs(graph.poses - before)[:, :2].max() < 0.1
    assert graph.closing_loss(0) > 100.0
    graph.drop_closing(0)
    graph.solve()
    assert graph.links == links
    np.testing.assert_allclose(graph.poses, before, atol=1e-9)
    graph.add_link(0, 29, np.array([28.98, 0.0, 0.0]), np.diag([1e4, 1e4, 1e4]), closing=1)
    graph.solve()
    assert graph.closing_loss(1) < 1.0 and graph.poses[29, 0] == pytest.approx(28.98, abs=0.02)


def test_the_window_is_the_graph_solved_step_by_step() -> None:
    """Patches, motions and linked scans: the window's last pose and covariance are those of the whole graph."""
    rng = np.random.default_rng(3)
    start_cov = 1e-6 * np.eye(3)
    window, graph = Window(np.zeros(3), start_cov), PoseGraph(np.zeros(3), start_cov)
    true, key, patches = np.zeros(3), 0, []
    for k in range(6):
        if k:
            motion = rng.normal(0, 0.3, 3)
            true = compose(true, motion)
            cov = random_covariance(3, rng, 1e-4)
            said = motion + np.linalg.cholesky(cov) @ rng.normal(0, 1, 3)
            window.step(said, cov)
            seen = np.arange(len(patches))
            at = true + 0.003 * rng.normal(0, 1, 3)
            z = relative(window.frames[seen], np.tile(at, (len(seen), 1)))
            info = np.array([np.linalg.inv(random_covariance(3, rng, 1e-5)) for _ in seen])
            gradient = np.einsum("kab,kb->ka", info, rng.normal(0, 0.002, (len(seen), 3)))
            links = Links(seen, z, info, gradient)
            pose, rows = window.ahead(np.zeros(3), np.zeros((3, 3)))
            mean, mean_cov = window.corrected(at, links, pose, rows)
            window.correct(at, links)
            np.testing.assert_allclose(window.pose, mean, atol=1e-9)
            np.testing.assert_allclose(window.cov[:3, :3], mean_cov, atol=1e-10)
            node = graph.add_node(window.pose)
            graph.add_link(key, node, said, np.linalg.inv(cov))
            for row, p in enumerate(seen):
                graph.add_link(patches[p], node, z[row], info[row], gradient[row])
            key = node
        for _ in range(2):
            info = np.linalg.inv(random_covariance(3, rng, 1e-5))
            patches.append(graph.add_node(window.pose))
            graph.add_link(key, patches[-1], np.zeros(3), info)
            window.add(patches[-1], info)
    graph.solve(iterations=10)
    np.testing.assert_allclose(window.pose, graph.poses[key], atol=1e-3)
    cov = graph.covariance([key, *patches])
    sigma = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(window.cov / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=0.03)
    window.keep(np.arange(len(patches)) >= 8)
    rest = np.r_[0:3, 27 : len(cov)]
    np.testing.assert_allclose(np.sqrt(np.diag(window.cov)), sigma[rest], rtol=0.02)


def test_a_closing_of_many_links_that_are_as_far_off_as_they_say_counts_in_full() -> None:
    """Its chi-square is that of all its links: what is usual for one is exceeded by any thirty."""
    rng, graph = np.random.default_rng(0), PoseGraph(np.zeros(3), 1e-6 * np.eye(3))
    graph.add_node(np.array([1.0, 0.0, 0.0]))
    for _ in range(30):
        z = np.array([1.0, 0.0, 0.0]) + rng.normal(0.0, 0.01, 3)
        graph.add_link(0, 1, z, 1e4 * np.eye(3), closing=0)
    graph.solve()
    assert 0.6 < graph.closing_loss(0) < 1.4
    np.testing.assert_allclose(graph.covariance([1]), 1e-6 * np.eye(3) + np.eye(3) / 3e5, rtol=0.02, atol=3e-6)
