"""What all fits share and what knows no term: Gaussians, the solver, robust rules, choice of orders, tests, reports."""
