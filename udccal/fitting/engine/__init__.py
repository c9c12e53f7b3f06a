"""Code that all fits share, independent of the term: Gaussians, solver, robust rules, choice of orders, tests."""
