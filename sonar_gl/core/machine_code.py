"""Reading of machine code that Numba has written to disk, without what only a compiler needs of it."""

from __future__ import annotations

from llvmlite import binding as llvm
from numba.core.caching import CompileResultCacheImpl
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import compile_result


class KeptLibrary(JITCodeLibrary):
    """A function's machine code, as read from disk, whose bitcode waits until it is needed.

    The files of a function hold it twice: as machine code, and as bitcode for functions that are compiled later and
    call it. Numba parses the bitcode whenever it reads a function, which takes longer than all else of reading.
    """

    @classmethod
    def read(
        cls, codegen, name: str, machine_code: bytes, bitcode: bytes, functions: list[str]
    ) -> KeptLibrary:
        """Return the library of these functions, those that Python asks for."""
        self = cls(codegen, name)
        self._bitcode = bitcode
        self.enable_object_caching()
        self._set_compiled_object(machine_code)
        # Numba looks functions up among those that the module defines. What they do there is never compiled: LLVM takes
        # the machine code of the whole module.
        definitions = (f'define void @"{function}"() {{ ret void }}' for function in functions)
        self._final_module.link_in(llvm.parse_assembly("\n".join(definitions)))
        self._finalize_final_module()
        return self

    def _get_module_for_linking(self):
        """Return the functions for one that is compiled now; Numba's own method knows the module above alone."""
        if self._shared_module is None:
            self._shared_module = llvm.parse_bitcode(self._bitcode)
        return self._shared_module


class ResultOnDisk(CompileResultCacheImpl):
    """Writes a compiled function as Numba does, and reads it into a KeptLibrary."""

    def rebuild(self, target_context, payload):
        """Return the compiled function, as Numba's method of this name."""
        (name, kind, code), fndesc, environment, signature, objectmode, lifted, annotation, *rest = payload
        reload_init, referenced_envs = rest
        if kind != "object":
            return super().rebuild(target_context, payload)
        for function in reload_init:
            function()
        functions = [fndesc.llvm_func_name, fndesc.llvm_cpython_wrapper_name]
        library = KeptLibrary.read(target_context.codegen(), name, *code, functions)
        entry_point = target_context.get_executable(library, fndesc, environment)
        for one in referenced_envs:
            library.codegen.set_env(one.env_name, one)
        return compile_result(
            target_context=target_context,
            typing_context=target_context.typing_context,
            library=library,
            environment=environment,
            entry_point=entry_point,
            fndesc=fndesc,
            type_annotation=annotation,
            signature=signature,
            objectmode=objectmode,
            lifted=lifted,
            reload_init=reload_init,
            referenced_envs=referenced_envs,
        )
