"""How kernels are compiled: as a whole where Python calls them, as a body for other kernels.

Numba finishes every function it meets: what only other functions call is optimised with all that it
calls in turn, and written out as machine code with ways in from Python and C, though its callers
take nothing but its intermediate code, which they optimise again.  Of a hundred kernels of a run
Python calls ten, so that most of that is for nothing.

Here a kernel is compiled to intermediate code first, its *body*.  When Python calls it, or a
function that is no kernel does, a *whole* is made of the body: with a way in from Python,
optimised together with the bodies that it contains, and as machine code.  Both are kept on disk
under the same name, the whole in place of the body; it brings its body for those who link it.
What a kernel computes does therefore not depend on who called it first.  What Numba writes of NumPy
for a kernel is a *piece* of it, intermediate code as well.
"""

from __future__ import annotations

import copy
import gc
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache
from typing import Any, ClassVar

from llvmlite import binding
from numba.core import event, sigutils
from numba.core.caching import CompileResultCacheImpl, NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.decorators import jit
from numba.core.environment import Environment, lookup_environment
from numba.core.registry import CPUDispatcher
from numba.core.target_extension import CPU, jit_registry
from numba.core.targetconfig import ConfigStack
from numba.core.types.functions import BaseFunction
from numba.core.types.misc import SliceLiteral
from numba.core.typing import Context as TypingContext

_ENVIRONMENT = "_ZN08NumbaEnv"  # how the names of variables begin that hold an environment

_depth = 0  # of kernels that are being compiled, one within the other, under the compiler's lock
_made = 0  # bodies that this process has compiled


class _Body(JITCodeLibrary):  # type: ignore[misc]  # Numba is not typed
    """Intermediate code of a kernel and of all it calls, of which each function is simplified.

    One that calls no other kernel is optimised by itself as well: a loop over its arguments, which
    LLVM does in registers there, may stay scalar where it has become part of another function.
    """

    def _optimize_functions(self, module: Any) -> None:
        # as Numba does, but for functions that are only named, most of all
        module.data_layout = self._codegen._data_layout
        passes, builder = self._codegen._function_pass_manager()
        for function in module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def _optimize_final_module(self) -> None:
        if not any(type(library) in (_Body, _Whole) for library in self._linking_libraries):
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        del name
        return 0

    @classmethod
    def restored(cls, codegen: Any, name: str, bitcode: bytes) -> _Body:
        self = cls(codegen, name)
        self._final_module = binding.parse_bitcode(bitcode)
        self._finalize_final_module()
        return self


class _Piece(_Body):
    """Intermediate code of a function of NumPy or Python as it is needed by a kernel."""

    def _optimize_final_module(self) -> None:
        pass


class _Whole(JITCodeLibrary):  # type: ignore[misc]
    """Machine code of a kernel, and its body as intermediate code for those who link it."""

    _body: bytes | None = None
    _shared_module: Any

    def _finalize_specific(self) -> None:
        super()._finalize_specific()
        for variable in self._final_module.global_variables:
            if variable.name.startswith(_ENVIRONMENT):
                environment = lookup_environment(variable.name)
                if environment is not None:
                    self._codegen.set_env(variable.name, environment)

    def _get_module_for_linking(self) -> Any:
        self._ensure_finalized()
        if self._shared_module is None:
            if self._body is None:
                (body,) = self._linking_libraries
                return body._get_module_for_linking()
            self._shared_module = binding.parse_bitcode(self._body)
        return self._shared_module

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        address: int = self._codegen._engine.get_function_address(name)
        return address

    @classmethod
    def restored(cls, codegen: Any, name: str, code: bytes, body: bytes) -> _Whole:
        self = cls(codegen, name)
        self.enable_object_caching()
        self._set_compiled_object(code)
        self._body = body
        self._finalize_final_module()
        return self


class _Types(TypingContext):  # type: ignore[misc]
    """Numba's knowledge of types, that remembers what a function of given arguments returns.

    Numba tries its definitions of a function one after another each time that it meets it: of `+`
    between two numbers alone some dozen, a thousand times.
    """

    _known: ClassVar[dict[Any, Any]] = {}

    def __init__(self, context: TypingContext) -> None:
        self.__dict__ = context.__dict__  # one and the same knowledge

    def resolve_function_type(self, function: Any, arguments: Any, named: Any) -> Any:
        find = super().resolve_function_type
        constants = any(isinstance(argument, SliceLiteral) for argument in arguments)
        if named or constants or not isinstance(function, BaseFunction):
            return find(function, arguments, named)
        key = function, tuple(arguments), ConfigStack.top_or_none()
        if key not in self._known:
            self._known[key] = find(function, arguments, named)
        return self._known[key]


_types = cache(_Types)  # one for Numba's: it keeps by context what it makes of its functions


class _Options(Flags):  # type: ignore[misc]
    """Numba's, compared by what is set, and not each time by all that could be."""

    _HASH = hash(Flags())  # of all of them

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Flags) and self._values == other._values

    def __hash__(self) -> int:
        return self._HASH


class _Compiler(Compiler):  # type: ignore[misc]
    """Numba's, that makes bodies."""

    _library: ClassVar[type[_Body]] = _Body

    def compile_extra(self, func: Any) -> Any:
        global _depth, _made
        state = self.state
        state.flags = _Options(state.flags)
        state.flags.no_cpython_wrapper = state.flags.no_cfunc_wrapper = True
        state.flags.no_compile = True
        context = state.targetctx
        state.typingctx = _types(state.typingctx)
        state.library = self._library(context.codegen(), func.__qualname__)
        _depth += 1
        _made += 1
        jit_registry.update({CPU: _piece})  # by which Numba compiles what kernels need of NumPy
        try:
            compiled = super().compile_extra(func)
        finally:
            _depth -= 1
            if not _depth:
                jit_registry.update({CPU: jit})
        # that by which callers find it, in place of something that Python could call
        compiled = compiled._replace(entry_point=object())
        context.insert_user_function(compiled.entry_point, compiled.fndesc, [compiled.library])
        return compiled


@contextmanager
def _no_search_for_cycles() -> Iterator[None]:
    """Let the interpreter not search for cycles among the very many objects of a compilation.

    Those that it leaves are not searched afterwards either.
    """
    searching, made = gc.isenabled(), _made
    gc.disable()
    try:
        yield
    finally:
        if _made > made:
            gc.freeze()
        if searching:
            gc.enable()


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """A function that Numba compiles when it is called."""

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        super().__init__(function, {}, {"nopython": True, **options}, _Compiler)

    def compile(self, sig: Any) -> Any:
        """Compile it, or load what was compiled."""
        arguments, result = sigutils.normalize_signature(sig)
        with global_compiler_lock:
            known = self.overloads.get(tuple(arguments))
            if _depth > 0 and known is not None:
                return known.entry_point
            with self._cache.claimed(arguments), _no_search_for_cycles():
                compiled = super().compile(sig)
                if _depth > 0:
                    return compiled
                known = self.overloads[tuple(arguments)]
                if isinstance(known.library, _Body):
                    details = {"dispatcher": self, "args": arguments, "return_type": result}
                    with event.trigger_event("numba:compile", data=details):
                        known = self._whole(known)
                    self.targetctx.insert_user_function(
                        known.entry_point, known.fndesc, [known.library]
                    )
                    self.add_overload(known)
                    self._cache.save_overload(sig, known)
                return known.entry_point

    def _whole(self, compiled: Any) -> Any:
        """Make of a body what Python can call."""
        self.targetctx.refresh()  # a body that was loaded needed nothing of what Numba knows
        flags = Flags()
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        # Ways in keep constants of their own in the environment, which is therefore another one
        # than that of the body.
        function = copy.copy(compiled.fndesc)
        function.env_name += "_whole"
        environment = Environment.from_fndesc(function)
        context = self.targetctx.subtarget(
            environment=environment, fndesc=function, enable_nrt=bool(flags.nrt)
        )
        library = _Whole(context.codegen(), compiled.library.name)
        library.enable_object_caching()
        library.add_linking_library(compiled.library)
        with ConfigStack().enter(flags):
            context.create_cpython_wrapper(
                library, function, environment, compiled.call_helper, flags.release_gil
            )
            entry = context.get_executable(library, function, environment)
        return compiled._replace(
            library=library, fndesc=function, environment=environment, entry_point=entry
        )

    def add_overload(self, cres: Any) -> None:
        """Note what was compiled; to Python only wholes are shown."""
        if isinstance(cres.library, _Body):
            self.overloads[tuple(cres.signature.args)] = cres
        else:
            super().add_overload(cres)


class _Unkept(NullCache):  # type: ignore[misc]
    """Where a piece is kept: nowhere, as the kernels that need it hold it."""

    def claimed(self, arguments: object) -> AbstractContextManager[None]:
        del arguments
        return nullcontext()


class _PieceCompiler(_Compiler):
    _library = _Piece


class _PieceDispatcher(Kernel):
    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        CPUDispatcher.__init__(self, function, {}, options, _PieceCompiler)
        self._cache = _Unkept()


def _piece(**options: Any) -> Callable[[Any], Any]:
    """Stand in for `numba.jit` where Numba compiles what a kernel needs of NumPy."""
    return lambda function: _PieceDispatcher(function, options)


class KernelStore(CompileResultCacheImpl):  # type: ignore[misc]
    """How bodies and wholes are written to disk and read again."""

    def reduce(self, cres: Any) -> tuple[Any, ...]:
        """Give what is written."""
        library = cres.library
        bitcode = library._get_module_for_linking().as_bitcode()
        code = None if isinstance(library, _Body) else library._get_compiled_object()
        function = copy.copy(cres.fndesc)
        function.typemap = function.calltypes = None  # not needed, and perhaps not to be written
        environments = tuple(cres._find_referenced_environments())
        return (
            library.name, code, bitcode, function, cres.environment, cres.signature,
            cres.reload_init, environments,
        )  # fmt: skip

    def rebuild(self, target_context: Any, payload: tuple[Any, ...]) -> Any:
        """Make of what was written what it had been."""
        name, code, bitcode, function, environment, signature, reload, environments = payload
        for again in reload:
            again()
        codegen = target_context.codegen()
        library: _Body | _Whole
        entry: Any
        if code is None:
            library, entry = _Body.restored(codegen, name, bitcode), object()
        else:
            library = _Whole.restored(codegen, name, code, bitcode)
            entry = target_context.get_executable(library, function, environment)
            for other in environments:
                codegen.set_env(other.env_name, other)
        return compile_result(
            target_context=target_context, typing_context=target_context.typing_context,
            library=library, environment=environment, entry_point=entry, fndesc=function,
            type_annotation="", signature=signature, objectmode=False, lifted=(),
            reload_init=reload, referenced_envs=environments,
        )  # fmt: skip
