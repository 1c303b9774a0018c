"""What only the study of the paper needs: rival systems, ablation, walks that are measured, the radius of HPR.

gsvis imports none of it. Benchmarks and tests do.
"""
