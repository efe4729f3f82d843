"""How fast, how right and how robust vijax is: every file asks a question, and is run by itself.

`yardstick` holds references in many digits, `peers` and `naive` what others would write, `charts` the pictures.
"""
