"""What only the study of the paper needs.

Rival systems, ablation, measured walks, the radius of HPR, and the search and the picture of figure 15. gsvis imports
none of it. Benchmarks and tests do.
"""
