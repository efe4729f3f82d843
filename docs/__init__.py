"""The pages of vijax: their build, the parts generated from the program, and the outputs of their code."""
