"""Publications, measured: each equation, table, figure and claim, and what becomes of it."""

from factorgraph_dvl.reproduce.beams import BEAMS
from factorgraph_dvl.reproduce.chen_2021 import CHEN_2021
from factorgraph_dvl.reproduce.entry import Paper
from factorgraph_dvl.reproduce.liu_2020 import LIU_2020
from factorgraph_dvl.reproduce.luo_2024 import LUO_2024
from factorgraph_dvl.reproduce.nine_state import NINE_STATE

PAPERS: dict[str, Paper] = {p.name: p for p in (LUO_2024, LIU_2020, NINE_STATE, BEAMS, CHEN_2021)}
