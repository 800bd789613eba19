"""Public names of `pfbench.door` and the modules that define them."""

from pfbench.door.laws import LawTable as LawTable, check_laws as check_laws
from pfbench.door.own_parts import make_own as make_own
from pfbench.door.parts import Part as Part, get_part as get_part, list_names as list_names
from pfbench.door.running import run_filters as run_filters, train_filter as train_filter
from pfbench.door.study import Study as Study, open_study as open_study
from pfbench.logs.own_logs import make_log as make_log
