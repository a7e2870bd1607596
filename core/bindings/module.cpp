// The Python module pileus_core.
#include "bindings.h"
#include "error.h"
#include "method.h"
#include "render.h"

#include <exception>
#include <string_view>

namespace pileus::python {

namespace {

/// Raises wrong input in Python. What a file put into the message and Python would not print, as a
/// mark that turns the line around, is shown escaped.
void raise_input_error(const std::exception_ptr& thrown, void* type) {
    try {
        std::rethrow_exception(thrown);
    } catch (const InputError& error) {
        const std::string_view what = error.what();
        const auto length = static_cast<Py_ssize_t>(what.size());
        const auto text = nb::steal(PyUnicode_DecodeUTF8(what.data(), length, "backslashreplace"));
        nb::list shown;
        for (const nb::handle letter : text) {
            const bool prints = nb::cast<bool>(letter.attr("isprintable")());
            shown.append(prints ? nb::borrow(letter)
                                : letter.attr("encode")("unicode_escape").attr("decode")());
        }
        PyErr_SetObject(static_cast<PyObject*>(type), nb::str("").attr("join")(shown).ptr());
    }
}

}  // namespace

NB_MODULE(_core, m) {
    m.doc() = "The Pileus renderer.";
    m.attr("__version__") = PILEUS_VERSION;
    m.attr("METHODS") = method_names();

    const nb::exception<InputError> input_error(m, "InputError", PyExc_ValueError);
    nb::register_exception_translator(raise_input_error, input_error.ptr());
    nb::exception<Cancelled>(m, "Cancelled", PyExc_Exception);

    bind_volume(m);
    bind_camera_and_lights(m);
    bind_look(m);
    bind_scene(m);
    bind_transport(m);
    bind_partial_and_frame(m);
    bind_render(m);
    bind_read_image(m);
    bind_writers_of_caches(m);
}

}  // namespace pileus::python
