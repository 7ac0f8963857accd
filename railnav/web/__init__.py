"""Pages and pictures: they show results and compute none. Needs the extra "report" (plotly, matplotlib)."""
