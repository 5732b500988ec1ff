"""Pictures of clouds and trajectories: what is shown (`scene`, `coloring`), how it is drawn (`draw`), whole pages."""
