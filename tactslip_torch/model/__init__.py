"""The kernel machine: scaling, closed-form solve, and the quadratic form it folds into."""
