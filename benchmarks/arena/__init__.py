"""The arena: systems trained on the same photographs, played over the same links, judged by photographs none has seen.

    course.py    photographs in name order as a walk; which of them train, which judge
    budget.py    processor seconds of a system, and training that stops when they are spent
    links.py     recorded links, scaled to a class
    stages.py    what a client shows after so many bytes, and when they arrive
    judge.py     PSNR of held-out photographs as the walk passes them, QoE, first images
    report.py    tables, and paired intervals against gsvis
    systems/     one system a file
    run.py       the command

Systems of others are simplified copies; each says what is simplified.
"""
