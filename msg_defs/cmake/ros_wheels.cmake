# Included right after project() when pip builds this package: finds ROS where the wheels of the build environment put it.
find_package(Python3 REQUIRED COMPONENTS Interpreter Development.Module)
execute_process(
  COMMAND "${Python3_EXECUTABLE}" -c "import ament_package, pathlib; print(pathlib.Path(ament_package.__file__).parents[4])"
  OUTPUT_VARIABLE ROS_PREFIX OUTPUT_STRIP_TRAILING_WHITESPACE COMMAND_ERROR_IS_FATAL ANY)
list(PREPEND CMAKE_PREFIX_PATH "${ROS_PREFIX}")
set(ENV{AMENT_PREFIX_PATH} "${ROS_PREFIX}")

# The wheels export include folders of the machine that built them, and CMake refuses folders that do not exist.
function(drop_foreign_includes)
  get_property(imported DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS imported)
    get_target_property(includes ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(includes)
      list(FILTER includes EXCLUDE REGEX "^/opt/python/")
      set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${includes}")
    endif()
  endforeach()
endfunction()
cmake_language(DEFER CALL drop_foreign_includes)

# What is generated in C++ is short, and includes much: all of a library at once takes a third of the time.
function(compile_at_once)
  foreach(kind IN ITEMS cpp fastrtps_c fastrtps_cpp introspection_cpp)
    set_target_properties(${PROJECT_NAME}__rosidl_typesupport_${kind} PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 0)
  endforeach()
endfunction()
cmake_language(DEFER CALL compile_at_once)
