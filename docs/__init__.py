"""The pages of vijax: what builds them, what they show of the program itself, and what their code printed."""
