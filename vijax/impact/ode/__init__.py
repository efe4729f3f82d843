"""The adaptive Runge-Kutta method of diffrax with located events, for any membrane law and dry friction.

Begin with `ode`.
"""
