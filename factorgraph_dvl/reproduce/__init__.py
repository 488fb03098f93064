"""Publications, measured: each equation, table, figure and claim, and what becomes of it."""

from factorgraph_dvl.reproduce.entry import Paper
from factorgraph_dvl.reproduce.luo_2024 import LUO_2024

PAPERS: dict[str, Paper] = {p.name: p for p in (LUO_2024,)}
