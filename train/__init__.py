"""Builds the reflector detector that the package ships: scenes, dataset, network, fit, evaluation, export.

Everything comes from declared distributions and a seed, so that anybody can make the model again.
"""
