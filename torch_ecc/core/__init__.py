"""The solve: pose algebra, sampling, what is prepared once per template, the loop, the verdict."""
