# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Nothing that came from a file or a process is run: the sources call nothing that could."""

import ast

from helpers.source import module_name, MODULES
import pytest

RUNS = {'eval', 'exec', 'compile', '__import__'}
UNPICKLE = {'pickle', '_pickle', 'cPickle', 'marshal', 'shelve', 'joblib', 'dill', 'cloudpickle'}
UNPICKLE |= {'xtf_read', 'xtf_read_gen'}
"""The readers of pyxtf unpickle an index beside the file."""
YAML = {'load', 'load_all', 'unsafe_load', 'full_load', 'UnsafeLoader', 'FullLoader', 'Loader'}


def faults(tree):
    """What of a module could run what it reads, as (line, what)."""
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or '', *(alias.name for alias in node.names)]
        if found := UNPICKLE.intersection(part for name in names for part in name.split('.')):
            yield node.lineno, found.pop()
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == 'yaml':
            if node.attr in YAML:
                yield node.lineno, f'yaml.{node.attr}'
        if isinstance(node, ast.Call):
            yield from _calls(node)


def _calls(node):
    called = ast.unparse(node.func)
    given = {word.arg: word.value for word in node.keywords}
    if called in RUNS or called in ('os.system', 'os.popen', 'builtins.eval', 'builtins.exec'):
        yield node.lineno, called
    if called.split('.')[-1] == 'load' and called.split('.')[0] in ('np', 'numpy'):
        if ast.unparse(given.get('allow_pickle', ast.Constant(True))) != 'False':
            yield node.lineno, 'np.load without allow_pickle=False'
    elif 'allow_pickle' in given and ast.unparse(given['allow_pickle']) != 'False':
        yield node.lineno, 'allow_pickle'
    if 'shell' in given and ast.unparse(given['shell']) != 'False':
        yield node.lineno, 'shell'


def test_no_module_runs_what_it_reads():
    found = {}
    for path in MODULES:
        name = module_name(path)
        wrong = list(faults(ast.parse(path.read_text(encoding='utf-8'))))
        if wrong:
            found[name] = wrong
    assert not found


@pytest.mark.parametrize(
    'source',
    [
        'import pickle',
        'from pickle import loads',
        'from concurrent import x; import numpy, joblib',
        'def f():\n    import marshal',
        'eval("1")',
        'exec(text)',
        'os.system("ls")',
        'yaml.load(text)',
        'yaml.load(text, yaml.SafeLoader)',
        'yaml.unsafe_load(text)',
        'np.load(file)',
        'np.load(file, allow_pickle=True)',
        'np.load(file, allow_pickle=x)',
        'np.savez(file, allow_pickle=True)',
        'subprocess.run(words, shell=True)',
    ],
)
def test_the_check_sees_what_runs(source):
    assert list(faults(ast.parse(source)))


@pytest.mark.parametrize(
    'source',
    [
        'np.load(file, allow_pickle=False)',
        'yaml.safe_load(text)',
        're.compile(text)',
        'json.load(f)',
    ],
)
def test_the_check_leaves_the_rest(source):
    assert not list(faults(ast.parse(source)))
